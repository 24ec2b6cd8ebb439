"""Measure the visibility of a hidden effect, and find equivalent effects.

Both are measured on the residual: readings minus predictions of the validated model in windows of
half a second that start from the readings (``real_replay.py``, MuJoCo only). The background is the
residual without hidden effects; each joint is in multiples of its RMS.

A rival is another effect of the catalogue with one or two free parameters. It is equivalent to the
hidden effect if, at its best values, it reproduces the change by the hidden effect to within
:data:`ALIKE` backgrounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from injections import (
    Recorded,
    bent_encoder,
    biased_encoder,
    drifting_clock,
    late_drive,
    late_drive_of,
    late_states,
    scaled_encoder,
)  # fmt: skip
from real_effects import EFFORT_EFFECTS, Concealed
from real_forms import compiled, law, push
from real_models import Machine
from real_replay import Floats, replay

ALIKE = 0.25
"""Largest difference, in backgrounds, between an equivalent effect and the hidden one. A quarter of
the unmodelled residual cannot decide between two effects."""
EFFORT_UNIT = 0.01
"""Background of effort readings, as a fraction of their RMS, because an echoed effort has no
noise."""
ROUNDS, HOPELESS, REACH = 4, 0.7, (0.01, 20.0)
"""Number of iterations for a rival's parameters; remaining share of an effect above which a rival
is dropped; range of the parameters, in multiples of the initial ones."""

Direction = Callable[[float], Concealed]
"""Function from a size to a rival effect."""


@dataclass(frozen=True)
class Rival:
    """Another effect, with the directions in which it can change the residual.

    Attributes:
        effect, joint: name and joint of the effect.
        directions: parameter directions, each with a size at which it is nearly linear.
    """

    effect: str
    joint: str | None
    directions: tuple[tuple[Direction, float], ...]


@dataclass
class Judge:
    """Measurement of effects on the held-out segments of one case.

    Attributes:
        machine: validated model.
        stretches: held-out recordings without hidden effects.
        recordings: folder of the machines.
    """

    machine: Machine
    stretches: Sequence[Recorded]
    recordings: Path
    _known: dict[int, tuple[Concealed, Floats]] = field(default_factory=dict)

    @cached_property
    def background(self) -> Floats:
        """(joints,) RMS residual without hidden effects, rad or m."""
        squares = np.concatenate([r**2 for r in self._plain])
        return np.sqrt(squares.mean(axis=0))

    def visibility(self, effect: Concealed) -> float:
        """RMS change of the residual at the joint with the largest change, in backgrounds.

        For effects of the effort sensor: change of the effort, in hundredths of its RMS.
        """
        if effect.effect in EFFORT_EFFECTS:
            return self._effort_visibility(effect)
        return float(np.sqrt(np.mean(self._moved(effect) ** 2, axis=0)).max())

    def rivals(self, effect: Concealed) -> list[list[str | None]]:
        """Return [effect, joint] of every equivalent effect."""
        if effect.effect in EFFORT_EFFECTS:
            return []
        target, own = self._moved(effect), (effect.effect, effect.joint)
        others = [r for r in rivals_of(self.machine) if (r.effect, r.joint) != own]
        alike = {(r.effect, r.joint) for r in others if self._left(target, r) <= ALIKE}
        if len(self.machine.joints) == 1:
            # The recording does not show which of two shifted streams was late.
            late = {("command_delay", self.machine.joints[0]), ("sensor_delay", None)}
            alike |= late - {own} if own in late else set()
        return [list(name) for name in sorted(alike, key=str)]

    def _left(self, target: Floats, rival: Rival) -> float:
        """RMS difference between hidden effect and best rival, in backgrounds.

        Friction is non-linear, so the directions are computed again at the resulting sizes.
        """
        first = np.array([size for _, size in rival.directions])
        sizes = first
        whole = float(np.sqrt(np.mean(target**2, axis=0)).max())
        left = np.inf
        for _ in range(ROUNDS):
            columns = np.stack(
                [
                    self._moved(make(float(size))).ravel()
                    for (make, _), size in zip(rival.directions, sizes, strict=True)
                ],
                axis=1,
            )
            weights = np.linalg.lstsq(columns, target.ravel(), rcond=None)[0]
            rest = (target.ravel() - columns @ weights).reshape(target.shape)
            left = min(left, float(np.sqrt(np.mean(rest**2, axis=0)).max()))
            if left <= ALIKE or left > HOPELESS * whole:
                break
            grown = sizes * weights / first
            sizes = first * np.where(grown < 0.0, -1.0, 1.0) * np.clip(np.abs(grown), *REACH)
        return left

    def _moved(self, effect: Concealed) -> Floats:
        """(states, joints) change of the residual in backgrounds, at common states."""
        if id(effect) in self._known:
            return self._known[id(effect)][1]
        machine = effect.falsify(self.machine) if effect.falsify else self.machine
        out = []
        for stretch, plain in zip(self.stretches, self._plain, strict=True):
            changed = effect.change(stretch) if effect.change else stretch
            now = self._residual(machine, changed)
            out.append(now - plain[: len(now)])
        moved: Floats = np.concatenate(out) / self.background
        # The effect is stored too, so that its id stays unique.
        self._known[id(effect)] = effect, moved
        return moved

    @cached_property
    def _plain(self) -> list[Floats]:
        return [self._residual(self.machine, r) for r in self.stretches]

    def _residual(self, machine: Machine, recorded: Recorded) -> Floats:
        """(states, joints) readings minus predictions, rad or m."""
        joint = machine.joints[0]
        bias = machine.value("encoder_bias", "bias")
        model = compiled(machine, self.recordings)
        beside = law(machine, recorded.metadata.get("controller"))
        delay = machine.value("command_delay", "delay", joint)
        predicted = replay(model, recorded, push(machine), beside, delay, lambda q: q - bias) + bias
        assert recorded.state.position is not None
        out: Floats = recorded.state.position - predicted
        return out

    def _effort_visibility(self, effect: Concealed) -> float:
        efforts = [r.command.effort for r in self.stretches if r.command.effort is not None]
        values = np.concatenate(efforts)
        level = float(np.sqrt(np.mean(values**2)))
        change = effect.parameters.get("scale_error", 0.0) * values
        change = change + effect.parameters.get("bias", 0.0)
        return float(np.sqrt(np.mean(change**2))) / (EFFORT_UNIT * level)


def rivals_of(machine: Machine) -> list[Rival]:
    """Return every effect that a diagnosis could report instead, on one machine."""
    heavier = (_heavier, 0.05 * machine.tool[1])
    out = [
        Rival("sensor_delay", None, ((_shifted(late_states), 0.01),)),
        Rival("clock_drift", None, ((_shifted(drifting_clock), 0.005),)),
        Rival("base_tilt", None, ((_tilted(0), 0.05), (_tilted(1), 0.05))),
        Rival("payload", None, (heavier,)),
        Rival("inertial_parameters", machine.joints[-1], (heavier,)),
    ]
    for joint in machine.joints:
        out += _of_joint(machine, joint)
    return out


def _of_joint(machine: Machine, joint: str) -> list[Rival]:
    """Return effects at one joint; an effect with several forms occurs once for each form."""
    drive = machine.drives[joint]
    # Effort in N*m or N of a servo error of 0.01 rad, or a twentieth of the dry friction.
    effort = 0.01 * drive.kp or 0.05 * drive.friction or 0.01
    damped = (_drive(joint, "damping"), 0.2 * drive.damping)
    rubbed = (_drive(joint, "friction"), 0.3 * max(drive.friction, 0.01))
    pushed = (_drive(joint, "preload"), effort)
    # On a slide the rotor's inertia is equivalent to mass, and the model of the drive has none.
    geared = (_drive(joint, "armature"), 1e-3) if drive.armature else (_heavier, 5.0)
    named: list[tuple[str, tuple[tuple[Direction, float], ...]]] = [
        ("encoder_bias", ((_read(biased_encoder, joint), 0.03),)),
        ("encoder_scale", ((_read(scaled_encoder, joint), 0.03),)),
        ("viscous_friction", (damped,)),
        ("coulomb_friction", (rubbed,)),
        # The direction is the difference to symmetric dry friction.
        ("asymmetric_friction", (pushed,)),
        ("joint_spring", (pushed, (_drive(joint, "spring"), effort))),
        ("armature", (geared,)),
    ]
    if machine.mode == "effort":
        named.append(("torque_constant", ((_louder, 0.1),)))
    else:
        gained = (_stiffer(joint), 0.2)
        bent = ((_bent(joint, 0.0), 0.03), (_bent(joint, np.pi / 2), 0.03))
        named += [
            ("encoder_eccentricity", bent),
            ("torque_constant", (gained,)),
            # These servos have no velocity gain; damping is in the joint.
            ("controller_gain", (gained,)),
            # A bias that is also in the servo's feedback rotates the model against gravity.
            ("encoder_bias", ((_drive(joint, "zero"), 0.05),)),
        ]
    if len(machine.joints) > 1:
        named.append(("command_delay", ((_late(joint), 0.02),)))
    else:
        named.append(("command_delay", ((_shifted(late_drive), 0.01),)))
    return [Rival(effect, joint, directions) for effect, directions in named]


def _changed(change: Callable[[Recorded], Recorded]) -> Concealed:
    return Concealed("", None, {}, "", change=change)


def _falsified(falsify: Callable[[Machine], Machine]) -> Concealed:
    return Concealed("", None, {}, "", falsify=falsify)


def _shifted(injection: Callable[[Recorded, float], Recorded]) -> Direction:
    return lambda size: _changed(lambda r: injection(r, size))


def _read(injection: Callable[[Recorded, str, float], Recorded], joint: str) -> Direction:
    return lambda size: _changed(lambda r: injection(r, joint, size))


def _bent(joint: str, phase: float) -> Direction:
    return lambda size: _changed(lambda r: bent_encoder(r, joint, size, phase))


def _late(joint: str) -> Direction:
    """Delay of one drive by whole messages."""
    return lambda size: _changed(lambda r: late_drive_of(r, joint, max(round(abs(size) / 0.02), 1)))


def _louder(size: float) -> Concealed:
    """Drive effort larger than the logged effort."""

    def change(r: Recorded) -> Recorded:
        assert r.command.effort is not None
        return replace(r, command=replace(r.command, effort=r.command.effort / (1.0 + size)))

    return _changed(change)


def _stiffer(joint: str) -> Direction:
    def falsify(m: Machine, size: float) -> Machine:
        gains = {name: kp * (1.0 - size) for name, kp in m.controllers.items()}
        return replace(m.with_drive(joint, kp=m.drives[joint].kp * (1.0 - size)), controllers=gains)

    return lambda size: _falsified(lambda m: falsify(m, size))


def _drive(joint: str, name: str) -> Direction:
    """Model with a smaller drive parameter; non-negative ones are limited to zero."""

    def falsify(m: Machine, size: float) -> Machine:
        value = getattr(m.drives[joint], name) - size
        least = 0.0 if name in ("damping", "friction", "armature") else -np.inf
        return m.with_drive(joint, **{name: max(value, least)})

    return lambda size: _falsified(lambda m: falsify(m, size))


def _tilted(axis: int) -> Direction:
    def falsify(m: Machine, size: float) -> Machine:
        roll, pitch = m.tilt
        return replace(m, tilt=(roll - size, pitch) if axis == 0 else (roll, pitch - size))

    return lambda size: _falsified(lambda m: falsify(m, size))


def _heavier(size: float) -> Concealed:
    """Machine with a larger payload than the model."""

    def falsify(m: Machine) -> Machine:
        body, mass = m.tool
        return replace(m, mass={**m.mass, body: max(m.mass.get(body, mass) - size, 0.02 * mass)})

    return _falsified(falsify)
