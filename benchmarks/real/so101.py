"""SO-101: effects that the vendor's model lacks by joint, and prediction errors by motion.

    python benchmarks/real/so101.py --out DIR [--by diagnose | identify] [--seconds 8]
                                      [--fit NAME ...] [--held-out NAME ...]

The script cuts ``--seconds`` out of each recording (to DIR/excerpts; they may not be
redistributed). It diagnoses (to DIR/why, unless it exists) or identifies (to DIR/identified). It
then replays the held-out excerpts, and the same segment of every motion that was not fitted, with
the vendor's model and the patched one.

Properties of these recordings: each joint's zero has an unknown offset against the model's, the
effort is an unsigned current, and six servos are read one after another within a sample. All six
joints are diagnosed together, because the pose of one joint determines the load of others.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from recorded import folder_of

from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.errors import TwinError
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial, make_trial

# Each joint moves in at least one of these recordings, and all joints in the first.
FIT = ("prbs_excitation", "reach_and_return", "single_joint_wrist_pitch")
HELD_OUT = ("multisine", "large_amplitude")
START = 12.0
COMMANDS = {"diagnose": ("diagnosis.json", "--seconds", "0"), "identify": ("identification.json",)}
"""Command -> file of its result, and options."""
# Effects whose identification needs motions that these recordings lack: reversals smaller than the
# backlash under a known load, and commands beyond the drive's limit.
NOT_SHOWN = ("backlash", "torque_saturation")


def excerpt(name: str, role: str, seconds: float, folder: Path) -> Path:
    """Cut a segment of a recording to its own file."""
    path = folder / f"{role}_{name}.mcap"
    whole = read_recording(folder_of("so101") / "recordings" / f"{name}.mcap")
    first = min(s.stamp[0] for s in whole.series.values()) + round(START * 1e9)

    def cut(series: JointSeries) -> JointSeries:
        inside = (series.stamp >= first) & (series.stamp < first + round(seconds * 1e9))
        return replace(
            series,
            stamp=series.stamp[inside],
            log_time=series.log_time[inside],
            position=None if series.position is None else series.position[inside],
            velocity=None if series.velocity is None else series.velocity[inside],
            effort=None,
        )

    folder.mkdir(parents=True, exist_ok=True)
    parts = [cut(s) for s in whole.series.values()]
    write_recording(path, parts, {**whole.metadata, "role": role})
    return path


def errors(model: Path, trials: list[Trial]) -> list[np.ndarray | None]:
    """(joints,) RMS position errors of each trial, rad; None if it diverged."""
    loaded = load_model(find_model(model))
    joints = loaded.realization.joints
    patched = loaded.patched or PatchedModel(tuple(joints))
    out: list[np.ndarray | None] = []
    for trial in trials:
        try:
            predicted = replay_patched(loaded.realization, patched, [trial], threads=1)[0]
        except TwinError:
            out.append(None)
            continue
        columns = [trial.joints.index(j) for j in patched.joints]
        left = predicted.position - trial.position[:, columns]
        out.append(np.sqrt(np.mean(left**2, axis=0)))
    return out


def main() -> None:
    """Cut, diagnose, replay, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--by", choices=COMMANDS, default="diagnose", help="which command fits")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--fit", nargs="+", default=list(FIT), metavar="NAME")
    parser.add_argument("--held-out", nargs="+", default=list(HELD_OUT), metavar="NAME")
    args = parser.parse_args()
    folder = folder_of("so101")
    cuts = args.out / "excerpts"
    names = {"fit": args.fit, "held_out": args.held_out}
    chosen = [excerpt(n, role, args.seconds, cuts) for role, each in names.items() for n in each]
    why = args.out / ("why" if args.by == "diagnose" else "identified")
    result, *options = COMMANDS[args.by]
    if not (why / result).is_file():
        command = [str(Path(sys.executable).with_name("pytest-twin")), args.by, *options]
        subprocess.run(
            [*command, str(folder / "model.xml"), *map(str, chosen), "--out", str(why)],
            check=False,
        )
    document = json.loads((why / result).read_text("utf-8"))
    print(f"verdict: {document['verdict']}")
    for finding in document.get("findings", ()):
        words = ", ".join(
            f"{name} {p['value']:.4g} {p['unit']}" for name, p in finding["parameters"].items()
        )
        doubt = " (these recordings cannot show it)" if finding["effect"] in NOT_SHOWN else ""
        print(f"  {finding['joint']}: {finding['effect']}{doubt}: {words}")
    for stage in document.get("stages", ()):
        print(f"  {stage['stage']}: {stage['state']}: {', '.join(stage['parameters'])}")
    everything = sorted(p.stem for p in (folder / "recordings").glob("*.mcap"))
    rest = [n for n in everything if n not in args.fit]
    motions = [excerpt(n, "held_out", args.seconds, cuts) for n in rest]
    trials = [make_trial(read_recording(path)) for path in motions]
    joints = load_model(folder / "model.xml").realization.joints
    print(f"\n{args.seconds:g} s of each motion that was not fitted, rms in mrad before -> after:")
    print("| motion | " + " | ".join(joints) + " |")
    print("|---" * (len(joints) + 1) + "|")
    nominal, patched = errors(folder / "model.xml", trials), errors(why, trials)
    for name, before, after in zip(rest, nominal, patched, strict=True):
        cells = ["diverged"] * len(joints)
        if before is not None and after is not None:
            cells = [f"{1e3 * b:.1f} -> {1e3 * a:.1f}" for b, a in zip(before, after, strict=True)]
        print(f"| {name} | " + " | ".join(cells) + " |")
    both = [
        (b, a) for b, a in zip(nominal, patched, strict=True) if b is not None and a is not None
    ]
    total = [
        1e3 * np.sqrt(np.mean(np.stack(each) ** 2, axis=0)) for each in zip(*both, strict=True)
    ]
    cells = [f"{b:.1f} -> {a:.1f}" for b, a in zip(*total, strict=True)]
    print("| all | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
