"""Pairs of sessions of a simulated arm, positions alone: is what changed named, with its value?

    python benchmarks/changes/arm_pairs.py --out DIR [NAME ...]

An arm with three joints is simulated by Pinocchio at 2 kHz, with Stribeck and load-dependent
friction, masses 4 % off, a delay of 4 ms, sensor noise and an encoder of 14 bits. The model has
none of these. Five recordings of 6 s are the earlier ones. Three are new, of which two repeat
earlier commands. NAME is a change of the list below; all by default. A case in DIR is kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
from positions import SURE, compare

LENGTH, MASS, ARMATURE = (0.25, 0.22, 0.15), (1.2, 0.8, 0.4), (0.02, 0.01, 0.004)
KP, KV, LIMIT = np.array([60.0, 40.0, 15.0]), np.array([2.0, 1.2, 0.4]), np.array([25.0, 15.0, 6.0])
FRICTION, VISCOUS = np.array([0.25, 0.2, 0.06]), np.array([0.25, 0.2, 0.05])
STEP, SAMPLE, SECONDS = 0.0005, 0.01, 6.0
MASS_ERROR, LATE, NOISE, COUNTS = 0.04, 0.004, 2e-4, 2**14
OLD, NEW = (0, 1, 2, 3, 4), (0, 1, 10)

CHANGES: Mapping[str, tuple[dict[str, object], dict[tuple[str, str | None], float]]] = {
    # name -> arguments of the plant, and what is right: effect and joint -> value of its change
    "nothing": ({}, {}),
    "payload": ({"payload": 0.25}, {("payload", None): 0.25}),
    "dry_friction": ({"dry": (0.0, 0.4, 0.0)}, {("coulomb_friction", "j2"): 0.4}),
    "servo_voltage": ({"volts": (1.0, 0.8, 1.0)}, {("controller_gain", "j2"): -0.2}),
    "servo_gain": ({"gain": (1.0, 1.0, 0.6)}, {("controller_gain", "j3"): -0.4}),
    "delay": ({"delay": 0.02}, {("command_delay", f"j{j}"): 0.02 for j in (1, 2, 3)}),
}


def arm(payload: float) -> pin.Model:
    """The real arm, kg at its tip."""
    model, parent, at = pin.Model(), 0, np.array([0.0, 0.0, 0.1])
    for i, (length, mass) in enumerate(zip(LENGTH, MASS, strict=True)):
        joint = pin.JointModelRZ() if i == 0 else pin.JointModelRY()
        parent = model.addJoint(parent, joint, pin.SE3(np.eye(3), at), f"j{i + 1}")
        real = mass * (1.0 + MASS_ERROR * (-1.0 if i == 1 else 1.0))
        inertia = np.diag([real * length**2 / 12.0] * 2 + [real * 1e-3])
        link = pin.Inertia(real, np.array([0.0, 0.0, length / 2.0]), inertia)
        model.appendBodyToJoint(parent, link, pin.SE3.Identity())
        at = np.array([0.0, 0.0, length])
    if payload:
        tip = pin.Inertia(payload, at, np.eye(3) * 1e-5)
        model.appendBodyToJoint(parent, tip, pin.SE3.Identity())
    model.armature = np.array(ARMATURE)
    return model


def mjcf() -> str:
    """The model that an engineer has."""
    bodies, servos = "", ""
    for i, (length, mass) in enumerate(zip(LENGTH, MASS, strict=True)):
        across = mass * length**2 / 12.0
        bodies += (
            f'<body pos="0 0 {0.1 if i == 0 else LENGTH[i - 1]}"><inertial pos="0 0 {length / 2}" '
            f'mass="{mass}" diaginertia="{across} {across} {mass * 1e-3}"/><joint name="j{i + 1}" '
            f'axis="{"0 0 1" if i == 0 else "0 1 0"}" armature="{ARMATURE[i]}" damping="0.1"/>'
        )
        servos += (
            f'<position name="a{i + 1}" joint="j{i + 1}" kp="{KP[i]}" kv="{KV[i]}" '
            f'forcerange="-{LIMIT[i]} {LIMIT[i]}"/>'
        )
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f"{bodies}{'</body>' * 3}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def commands(seed: int) -> np.ndarray:
    """(samples, 3) rad, three sines for each joint."""
    draw, time = np.random.default_rng(seed), np.arange(0.0, SECONDS, SAMPLE)[:, None, None]
    frequency, phase = draw.uniform(0.15, 0.9, (3, 3)), draw.uniform(0.0, 2.0 * np.pi, (3, 3))
    size = draw.uniform(0.1, 0.35, (3, 3)) / (1.0 + frequency)
    wave = size * (np.sin(2.0 * np.pi * frequency * time + phase) - np.sin(phase))
    return np.array([0.0, 0.6, 0.7]) + np.minimum(time[:, 0], 1.0) * wave.sum(axis=2)


def record(
    path: Path, seed: int, noise: int, *, payload: float = 0.0, delay: float = 0.0,
    dry: Sequence[float] = (0.0,) * 3, volts: Sequence[float] = (1.0,) * 3,
    gain: Sequence[float] = (1.0,) * 3,
) -> Path:  # fmt: skip
    """Simulate one recording from rest, and write positions and commands at 100 Hz."""
    model, sent = arm(payload), commands(seed)
    data, supply = model.createData(), np.array(volts)
    kp, level = KP * np.array(gain), FRICTION + np.array(dry)
    q, v, positions = sent[0].copy(), np.zeros(3), []
    settle, each = 3000, round(SAMPLE / STEP)
    for k in range(-settle, round(SECONDS / STEP)):
        if k >= 0 and k % each == 0:
            positions.append(q.copy())
        at = int(np.clip((k * STEP - LATE - delay) // SAMPLE, 0, len(sent) - 1))
        drive = np.clip(kp * (sent[at] - q) - KV * v, -LIMIT, LIMIT) * supply
        load = np.abs(pin.computeGeneralizedGravity(model, data, q))
        sliding = level + 0.3 * FRICTION * np.exp(-((v / 0.08) ** 2)) + 0.02 * load
        friction = sliding * np.tanh(v / 0.004) + VISCOUS * v
        v = v + STEP * pin.aba(model, data, q, v, drive - friction)
        q = q + STEP * v
    draw, turn = np.random.default_rng(noise), 2.0 * np.pi / COUNTS
    seen = np.round((np.array(positions) + NOISE * draw.standard_normal((len(sent), 3))) / turn)
    columns = [f"j{i}.{what}" for what in ("position", "command") for i in (1, 2, 3)]
    table = np.column_stack([SAMPLE * np.arange(len(sent)), seen * turn, sent])
    np.savetxt(path, table, "%.6f", ",", header=",".join(["time", *columns]), comments="")
    return path


def main() -> None:
    """Run cases and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", help="changes; all by default")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    folder = args.out / "recordings"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf())
    before = [record(folder / f"old{seed}.csv", seed, 100 + seed) for seed in OLD]
    for name in args.names or CHANGES:
        changed, right = CHANGES[name]
        new = [record(folder / f"{name}{s}.csv", s, 200 + s, **changed) for s in NEW]  # type: ignore[arg-type]
        document = compare((folder / "model.xml", before, new), args.out / name)
        print(f"{name}: {document['verdict']}")
        for finding in document["findings"]:
            value = next(iter(finding["change"].values()))
            true = right.get((finding["effect"], finding["joint"]))
            wrong = " WRONG" if true is None and finding["confidence"] >= SURE else ""
            print(
                f"  {finding['effect']} {finding['joint']} {finding['confidence']:.2f}: "
                f"{value['value']:.4g} ({value['ci95'][0]:.4g} to {value['ci95'][1]:.4g}), "
                f"true {true}{wrong}"
            )


if __name__ == "__main__":
    main()
