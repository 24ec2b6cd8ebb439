"""Random serial arms whose efforts Pinocchio computes, built joint by joint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio
from scipy import signal

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Link:
    """One joint with its link and drive, SI units.

    Attributes:
        axis: ``x``, ``y`` or ``z`` of the link's frame.
        offset: position of the joint in the frame of the link before.
        turn: rotation of the frame about the x axis of the link before, rad.
        mass, com, inertia: body; second moments about the centre of mass.
        armature, viscous, dry, stribeck, bias: drive.
    """

    axis: str
    offset: tuple[float, float, float]
    turn: float
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float]
    armature: float
    viscous: float
    dry: float
    stribeck: float
    bias: float


def drawn_arm(random: np.random.Generator, joints: int, stribeck: float = 0.0) -> list[Link]:
    """Draw an arm that gets lighter towards its tip, with right angles between its frames.

    Args:
        stribeck: dry friction that vanishes at speed, relative to the rest of it: no column has it.
    """
    links = []
    for k in range(joints):
        mass = float(random.uniform(2.0, 6.0)) / (1.0 + k)
        length = float(random.uniform(0.15, 0.45))
        gyration = mass * length**2 / 12.0
        dry = float(random.uniform(0.3, 1.5)) / (1.0 + 0.5 * k)
        links.append(Link(
            axis="z" if k == 0 else str(random.choice(["x", "y", "z"])),
            offset=(0.0, 0.0, 0.0) if k == 0 else (length, 0.0, float(random.uniform(-0.1, 0.1))),
            turn=float(random.choice([0.0, np.pi / 2])),
            mass=mass,
            com=tuple((np.array([0.5, 0.1, 0.1]) * length * random.uniform(0.3, 1.3, 3)).tolist()),
            inertia=tuple((gyration * random.uniform([0.3, 0.9, 0.9], [0.5, 1.3, 1.3])).tolist()),
            armature=float(random.uniform(0.05, 0.6)) / (1.0 + k),
            viscous=float(random.uniform(0.2, 2.0)) / (1.0 + k),
            dry=dry,
            stribeck=stribeck * dry,
            bias=float(random.uniform(-0.3, 0.3)),
        ))  # fmt: skip
    return links


def names_of(links: list[Link]) -> list[str]:
    return [f"joint{k + 1}" for k in range(len(links))]


def plant_effort(links: list[Link], q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """(n, joints) efforts of the drives along a motion, with friction, armature and offset."""
    model = pinocchio.Model()
    before = 0
    for name, link in zip(names_of(links), links, strict=True):
        turn = pinocchio.utils.rotate("x", link.turn)
        joint = getattr(pinocchio, f"JointModelR{link.axis.upper()}")()
        before = model.addJoint(before, joint, pinocchio.SE3(turn, np.array(link.offset)), name)
        body = pinocchio.Inertia(link.mass, np.array(link.com), np.diag(link.inertia))
        model.appendBodyToJoint(before, body, pinocchio.SE3.Identity())
    data = model.createData()
    effort = np.array([pinocchio.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    for k, link in enumerate(links):
        stiction = link.stribeck * np.exp(-((v[:, k] / 0.1) ** 2))
        effort[:, k] += link.armature * a[:, k] + link.viscous * v[:, k] + link.bias
        effort[:, k] += (link.dry + stiction) * np.sign(v[:, k])
    return effort


def mjcf(links: list[Link], rounding: float = 0.0, errors: np.ndarray | None = None) -> str:
    """MJCF of the arm as a drawing has it: no friction, no armature.

    Args:
        rounding: error of the right angles, rad, as exporters write them.
        errors: (joints,) relative errors of masses and inertias.
    """
    factor = 1.0 + (np.zeros(len(links)) if errors is None else errors)
    text = end = ""
    for k, (name, link) in enumerate(zip(names_of(links), links, strict=True)):
        turn = link.turn + (rounding if link.turn else 0.0)
        quat = f"{np.cos(turn / 2):.17g} {np.sin(turn / 2):.17g} 0 0"
        inertia = " ".join(f"{factor[k] * i:.9g}" for i in link.inertia)
        text += (
            f'<body name="link{k + 1}" pos="{" ".join(map(str, link.offset))}" quat="{quat}">'
            f'<inertial pos="{" ".join(map(str, link.com))}" mass="{factor[k] * link.mass:.9g}" '
            f'diaginertia="{inertia}"/>'
            f'<joint name="{name}" axis="{" ".join(map(str, AXES[link.axis]))}"/>'
        )
        end += "</body>"
    compiler = '<compiler angle="radian"/>'
    return f'<mujoco model="drawn">{compiler}<worldbody>{text}{end}</worldbody></mujoco>'


def motion(
    random: np.random.Generator, joints: int, seconds: float, rate: float, top: float = 0.6
) -> tuple[np.ndarray, ...]:
    """Time (n,), positions, velocities and accelerations (n, joints) of a random Fourier series."""
    time = np.arange(round(seconds * rate)) / rate
    frequency = 2 * np.pi * top / 5 * np.arange(1, 6)
    sine, cosine = random.uniform(-0.35, 0.35, (2, 5, joints)) / np.arange(1, 6)[:, None] ** 0.5
    s, c = np.sin(np.outer(time, frequency)), np.cos(np.outer(time, frequency))
    q = s @ sine + c @ cosine
    v = (c * frequency) @ sine - (s * frequency) @ cosine
    a = -(s * frequency**2) @ sine - (c * frequency**2) @ cosine
    return time, q, v, a


def write_log(
    path: Path,
    links: list[Link],
    random: np.random.Generator,
    seconds: float = 12.0,
    rate: float = 100.0,
    order: list[int] | None = None,
) -> Path:
    """Write a recording with noise of encoders (2e-5 rad) and efforts (1 %, below 8 Hz)."""
    time, q, v, a = motion(random, len(links), seconds, rate)
    effort = plant_effort(links, q, v, a)
    noise = signal.sosfilt(
        signal.butter(1, 8.0, fs=rate, output="sos"), random.standard_normal(effort.shape), axis=0
    )
    effort += 0.01 * effort.std(axis=0) * noise / noise.std(axis=0)
    q = q + 2e-5 * random.standard_normal(q.shape)
    columns = list(range(len(links))) if order is None else order
    names = names_of(links)
    head = [f"{names[k]}.{what}" for k in columns for what in ("position", "effort")]
    table = np.column_stack([x[:, k] for k in columns for x in (q, effort)])
    np.savetxt(
        path, np.column_stack([time, table]), fmt="%.9g", delimiter=",",
        header=",".join(["time", *head]), comments="",
    )  # fmt: skip
    return path
