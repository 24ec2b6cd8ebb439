"""Draw blind cases from recordings of real machines with hidden effects. One seed, one case.

    python benchmarks/concealed/real_cases.py --out DIR --truth DIR --seeds 81000:81072 [--before]

Writes for each seed ``DIR/<case>/model.xml`` (where needed ``effects.json``, ``twin.yaml``) and
``recordings/*.mcap``, and the truth elsewhere. The recordings are found by ``TWIN_RECORDINGS``.
Neither they nor the cases may be redistributed.

Any 72 consecutive seeds contain 12 cases without a hidden effect, 50 with one effect and 10 with
two. In 8 of the 12, the recording was quantized, thinned out or has a low-passed velocity, which is
no physics of the robot. An effect is hidden in one of two ways:

- the recordings are changed (``injections.py``) as if the machine had an additional error;
- the model is falsified: a mass, friction, gain, rotor inertia, tilt or a whole law of the
validated model (``real_models.py``) is removed or scaled.

The truth file has the catalogue name of each effect and the parameters that a diagnosis should
find. ``visibility`` is the change of the held-out residual, in multiples of the residual without
hidden effects. ``equivalents`` are effects that change it in the same way, as measured by
simulation (``real_rivals.py``). ``background`` lists effects of the machine that the validated
model lacks; findings of these are not false.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from injections import (
    Recorded,
    cut,
    dropped_states,
    echoed_effort,
    filtered_velocity,
    of_joints,
    quantized_encoder,
)  # fmt: skip
from real_effects import CHOICES, DRAWS, EFFORT_EFFECTS, Change, Concealed
from real_forms import effects_json, mjcf, twin_yaml
from real_models import MACHINES, Machine
from real_rivals import Judge

from pytest_twin.formats.mcap import read_recording, write_recording

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).resolve().parents[3] / "shared/recordings"
)
COUNTS = {
    "emps": 20, "xl330": 16, "so101_pan": 10, "so101_flex": 10, "so101_roll": 8, "so101_wrist": 8,
}  # fmt: skip
"""Number of cases of each machine in a block."""
PLAIN = ("emps", "xl330", "so101_pan", "so101_wrist")
"""Machines with a case without any change."""
DISTURBED = {"emps": 2, "xl330": 2, "so101_pan": 1, "so101_flex": 1, "so101_roll": 1,
             "so101_wrist": 1}  # fmt: skip
TWO = {"emps": 3, "xl330": 2, "so101_pan": 2, "so101_flex": 2, "so101_roll": 1, "so101_wrist": 0}
"""Number of cases with disturbed recordings, and with two effects."""
STEP = {"emps": 0.001, "xl330": 0.001, "so101": 0.002}
"""Time step of the models, s."""
BLOCK = sum(COUNTS.values())
ORDER = np.random.default_rng(20_261_128).permutation(BLOCK)
EARLIER = 5
"""Largest number of segments of an earlier session."""
VISIBLE, TRIES = 1.0, 6
"""Smallest visibility, and largest number of draws to reach it."""
APART = (
    {"command_delay", "sensor_delay", "clock_drift"},
    {"encoder_scale", "controller_gain", "torque_constant", "payload", "encoder_eccentricity"},
    {"base_tilt", "encoder_bias", "asymmetric_friction"},
    {"torque_rolloff", "motor_load_friction", "controller_gain"},
    {"effort_bias", "effort_scale"},
)
"""Pairs of similar effects, which are not hidden together."""


def plan(seed: int) -> tuple[str, str, int]:
    """Return the machine, the kind of case, and its number within the kind, for a seed."""
    place = int(ORDER[seed % BLOCK])
    for name, count in COUNTS.items():
        if place >= count:
            place -= count
            continue
        plain = int(name in PLAIN)
        if place < plain:
            return name, "none", 0
        place -= plain
        if place < DISTURBED[name]:
            return name, "disturbed", place
        place -= DISTURBED[name]
        if place < TWO[name]:
            return name, "two", place
        place -= TWO[name]
        # The next block continues in the list of effects where this one ended.
        return name, "one", place + (seed // BLOCK) * (count - plain - DISTURBED[name] - TWO[name])
    raise AssertionError("a place of the block belongs to no machine")


def excerpts(
    machine: Machine, rng: np.random.Generator
) -> tuple[list[tuple[str, Recorded]], list[tuple[str, float]]]:
    """Return file names and segments of recordings with roles: three to fit, one held out.

    With the recording and start, s, of each.
    """
    fit = rng.permutation(len(machine.fit))[:3]
    chosen = [(machine.fit[i], "fit") for i in sorted(fit)]
    held = rng.permutation(len(machine.held_out))[:1]
    chosen += [(machine.held_out[i], "held_out") for i in sorted(held)]
    taken: list[tuple[str, float]] = []
    out = []
    for number, ((name, first, last), role) in enumerate(chosen):
        # Two segments overlap by at most a second, if possible.
        starts, free = _starts(name, first, last, machine.seconds - 1.0, taken, rng)
        start = (free or starts)[0]
        taken.append((name, start))
        out.append((f"{number}_{name}.mcap", _segment(machine, name, start, role)))
    return out, taken


def earlier_excerpts(
    machine: Machine, taken: Sequence[tuple[str, float]], rng: np.random.Generator
) -> list[tuple[str, Recorded]]:
    """Return file names and segments that share nothing with each other or those of the case."""
    out, used = [], list(taken)
    stretches = dict.fromkeys((*machine.fit, *machine.held_out))
    for name, first, last in [*stretches] * EARLIER:
        _, free = _starts(name, first, last, machine.seconds, used, rng)
        if free and len(out) < EARLIER:
            used.append((name, free[0]))
            segment = _segment(machine, name, free[0], "fit")
            out.append((f"{len(out)}_{name}.mcap", segment))
    return out


def _segment(machine: Machine, name: str, start: float, role: str) -> Recorded:
    read = read_recording(RECORDINGS / machine.folder / "recordings" / f"{name}.mcap")
    kept = {k: v for k, v in read.metadata.items() if k in ("controller", "temperature")}
    whole = Recorded(read.series["state"], read.series["command"], {**kept, "role": role})
    stretch = of_joints(cut(whole, start, machine.seconds), machine.joints)
    # SO-101's effort is an unsigned current, which a model cannot predict.
    return replace(stretch, state=replace(stretch.state, effort=None))


def _starts(
    name: str, first: float, last: float, apart: float, taken: Sequence[tuple[str, float]],
    rng: np.random.Generator,
) -> tuple[list[float], list[float]]:  # fmt: skip
    """Draw starts, s; all of them, and those at least ``apart`` s from each that is taken."""
    starts = np.round(rng.uniform(first, last, 40), 2).tolist()
    free = [
        start for start in starts
        if all(name != n or abs(start - s) >= apart for n, s in taken)
    ]  # fmt: skip
    return starts, free


def disturbed(machine: Machine, number: int, rng: np.random.Generator) -> tuple[str, Change]:
    """Draw a disturbance by a recorder or driver: its description, and the change."""
    joint = machine.joints[-1]
    kinds = ["quantized", "dropped"] if machine.name == "emps" else ["dropped", "filtered"]
    if machine.folder == "so101":
        kinds = ["quantized", "dropped", "filtered"]
    kind = kinds[(number + list(COUNTS).index(machine.name)) % len(kinds)]
    if kind == "quantized":
        low, high = (2e-4, 6e-4) if machine.name == "emps" else (4e-3, 8e-3)
        step = float(f"{rng.uniform(low, high):.3g}")
        return f"{joint} quantized by {step}", lambda r: quantized_encoder(r, joint, step)
    if kind == "dropped":
        share, seed = float(f"{rng.uniform(0.2, 0.5):.3g}"), int(rng.integers(2**31))
        return (
            f"{share:.0%} of the states dropped",
            lambda r: dropped_states(r, share, np.random.default_rng(seed)),
        )
    lag = float(f"{rng.uniform(0.02, 0.08):.3g}")
    return (
        f"velocity of {joint} low-passed with {lag} s",
        lambda r: filtered_velocity(r, joint, lag),
    )


def two_apart(names: Sequence[str], rng: np.random.Generator) -> list[str]:
    """Draw two effects that are not similar."""
    while True:
        first, second = (str(name) for name in rng.permutation(names)[:2])
        if not any({first, second} <= alike for alike in APART):
            return [first, second]


def concealed(
    machine: Machine, kind: str, number: int, judge: Judge, rng: np.random.Generator
) -> list[Concealed]:
    """Draw the effects of a case, each until it is visible; else the most visible draw is used."""
    names = CHOICES[machine.name]
    wanted = [names[number % len(names)]] if kind == "one" else two_apart(names, rng)
    out = []
    for name in wanted:
        joint = str(rng.choice(machine.joints))
        drawn = []
        for _ in range(TRIES):
            drawn.append(DRAWS[name](machine, joint, rng))
            if judge.visibility(drawn[-1]) >= VISIBLE:
                break
        out.append(max(drawn, key=judge.visibility))
    return out


def write_model(machine: Machine, folder: Path) -> None:
    """Write ``model.xml`` and, if the machine has them, ``effects.json`` and ``twin.yaml``."""
    (folder / "model.xml").write_text(mjcf(machine, RECORDINGS))
    for file, text in (("effects.json", effects_json(machine)), ("twin.yaml", twin_yaml(machine))):
        if text is not None:
            (folder / file).write_text(text)


def make(seed: int, out: Path, truth: Path, *, has_before: bool = False) -> str:
    """Write one case; returns its name.

    Args:
        has_before: whether unaltered segments of the machine are in the folder ``before``.
    """
    rng = np.random.default_rng([20_261_128, seed])
    name = f"real{seed}"
    machine_name, kind, number = plan(seed)
    machine = MACHINES[machine_name]
    files, taken = excerpts(machine, rng)
    effects: list[Concealed] = []
    words = ""
    change: Change = lambda r: r  # noqa: E731
    judge = Judge(machine, [r for _, r in files if r.metadata["role"] == "held_out"], RECORDINGS)
    if kind == "disturbed":
        words, change = disturbed(machine, number, rng)
    elif kind != "none":
        effects = concealed(machine, kind, number, judge, rng)
    echoes = machine.mode == "effort" and any(e.effect in EFFORT_EFFECTS for e in effects)
    folder = out / name
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    for file, recorded in files:
        written = change(echoed_effort(recorded) if echoes else recorded)
        for effect in effects:
            written = effect.change(written) if effect.change else written
        write_recording(
            folder / "recordings" / file, [written.state, written.command], written.metadata
        )
    if has_before:
        earlier = folder / "before" / "recordings"
        earlier.mkdir(parents=True, exist_ok=True)
        for file, recorded in earlier_excerpts(
            machine, taken, np.random.default_rng([20_261_128, seed, 1])
        ):
            written = echoed_effort(recorded) if echoes else recorded
            write_recording(earlier / file, [written.state, written.command], written.metadata)
    model = machine
    for effect in effects:
        model = effect.falsify(model) if effect.falsify else model
    write_model(model, folder)
    record: dict[str, Any] = {
        "case": name, "family": "real", "machine": machine.name,
        "kind": "none" if kind == "disturbed" else kind, "mode": machine.mode,
        "joints": list(machine.joints), "contact": False,
        "effects": [
            {"effect": e.effect, "joint": e.joint, "parameters": dict(e.parameters), "how": e.how,
             "in": "recordings" if e.change else "model",
             "visibility": float(f"{judge.visibility(e):.2g}"), "equivalents": judge.rivals(e)}
            for e in effects
        ],
        "disturbed": words, "outside": None,
        "background": [
            {"effect": effect, "joint": joint, "parameters": dict(size), "why": why}
            for effect, (size, why) in machine.background.items()
            for joint in ((None,) if effect == "sensor_delay" else machine.joints)
        ],
        "recordings": [file for file, _ in files], "seconds": machine.seconds,
        "step": STEP[machine.folder],
    }  # fmt: skip
    truth.mkdir(parents=True, exist_ok=True)
    (truth / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
    return name


def main() -> None:
    """Write the cases of some seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seeds", default=f"0:{BLOCK}", help="first:last, last not included")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--before", action="store_true", help="with an earlier unaltered session")
    args = parser.parse_args()
    if not RECORDINGS.is_dir():
        parser.error(f"no recordings at {RECORDINGS}: set TWIN_RECORDINGS to their folder")
    first, _, last = args.seeds.partition(":")
    seeds = range(int(first), int(last) if last else int(first) + 1)
    with ProcessPoolExecutor(args.jobs) as pool:
        jobs = [
            pool.submit(make, seed, args.out, args.truth, has_before=args.before) for seed in seeds
        ]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
