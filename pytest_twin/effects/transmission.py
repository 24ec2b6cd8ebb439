"""Transmission effects: everything between the drive and the link."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, ModelFields, Parameter, PoseShift, Values, World
from pytest_twin.effects.fast_clip import fast_clip
from pytest_twin.effects.motor_side import Gear
from pytest_twin.effects.proposal import JointFit, Start


class JointSpring(Effect):
    """A passive spring at the joint: a balancing spring, a cable bundle, a seal."""

    id = "joint_spring"
    family = "transmission"
    nearly_linear = True
    law = "effort = preload - stiffness q"
    source = "Siciliano et al., Robotics (2009), sec. 7.2"
    parameters = (
        Parameter(
            "stiffness", "stiffness", 0.0, -2.0, 20.0, (0.1,), "stiffness",
            meaning="spring stiffness", relation="added",
        ),
        Parameter(
            "preload", "effort", 0.0, -10.0, 10.0, (0.1,), "effort", meaning="effort at q = 0"
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "controller_gain": "move the joint with the drive off: only a spring remains",
        "base_tilt": "change another joint's pose: the effort of a spring stays the same",
        "encoder_bias": "hold poses far apart: a spring's effort grows with the angle",
        "asymmetric_friction": "hold poses far apart: a spring's effort grows with the angle",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.stiffness += values["stiffness"]
        fields.constant_force += values["preload"]


def _neighbour_values(x: FloatArray, side: int) -> FloatArray:
    """(..., joints) values of the previous (-1) or next (1) joint; zero where there is none."""
    out = np.zeros_like(x)
    if side < 0:
        out[..., 1:] = x[..., :-1]
    else:
        out[..., :-1] = x[..., 1:]
    return out


class JointCoupling(Effect):
    """The drive of a neighbouring joint also moves this joint: a differential, a cable, a belt."""

    id = "joint_coupling"
    family = "transmission"
    law = (
        "form 0: delivered_j += ratio drive_(j-1); "
        "form 1: delivered_j += ratio drive_(j+1); "
        "form 2: motor angle = q_j - ratio q_(j-1), delivered_(j-1) -= ratio drive_j; "
        "form 3: as form 2 with j+1; "
        "form 4: measured_j = q_j + ratio q_(j-1); "
        "form 5: as form 4 with j+1"
    )
    source = "Siciliano et al., Robotics (2009), sec. 5.1: transmissions that couple joints"
    parameters = (
        Parameter("ratio", "one", 0.0, -2.0, 2.0, (0.1,), meaning="coupling ratio"),
        Parameter(
            "form", "one", None, 0.0, 5.0, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0), choice=True,
            meaning="kind of coupling",
            choices=(
                "effort of the previous joint's drive",
                "effort of the next joint's drive",
                "motor turned by the previous joint",
                "motor turned by the next joint",
                "encoder turned by the previous joint",
                "encoder turned by the next joint",
            ),
        ),
    )  # fmt: skip
    reads_other_joints = True
    confused_with: ClassVar = {
        "inertial_parameters": "hold the neighbouring joint still under load: only a coupling acts "
        "on this joint",
    }

    def drive(self, world: World, values: Values) -> None:
        # Parameters are constant over a simulation: the forms are looked up once.
        ratios = world.state.get(self.id)
        if ratios is None:
            ratios = world.state[self.id] = self._drive_ratios(values)
        drive = world.delivered
        for side, turns_motor, ratio in ratios:
            if not turns_motor:
                world.delivered = world.delivered + ratio * _neighbour_values(drive, side)
                continue
            # The servo controls its motor, whose angle differs by the neighbour's share.
            pull = world.stiffness * _neighbour_values(world.position, side)
            pull = pull + world.damping * _neighbour_values(world.velocity, side)
            held = fast_clip(world.delivered + ratio * pull, world.lower, world.upper)
            turned = np.where(ratio != 0.0, held, world.delivered)
            world.delivered = turned - _neighbour_values(ratio * turned, -side)

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        read = [(side, ratio[:, None]) for side, ratio in self._encoder_ratios(values)]
        more = [
            sum(ratio * _neighbour_values(x, side) for side, ratio in read)
            for x in (position, velocity)
        ]
        return position + more[0], velocity + more[1]

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        read = self._encoder_ratios(values)
        return self._decouple(position, read), self._decouple(velocity, read)

    @staticmethod
    def _decouple(measured: FloatArray, read: Sequence[tuple[int, FloatArray]]) -> FloatArray:
        """True (rows, joints) values behind ``measured``, solved along the chain."""
        true = measured
        for _ in range(measured.shape[1] - 1 if read else 0):
            true = measured - sum(ratio * _neighbour_values(true, side) for side, ratio in read)
        return true

    @staticmethod
    def _encoder_ratios(values: Values) -> list[tuple[int, FloatArray]]:
        """(-1 or 1 for the neighbour that turns the encoder, (rows, joints) ratios)."""
        found = [
            (side, values["ratio"] * (values["form"] == form)) for side, form in ((-1, 4), (1, 5))
        ]
        return [each for each in found if each[1].any()]

    @staticmethod
    def _drive_ratios(values: Values) -> list[tuple[int, bool, FloatArray]]:
        """(-1 or 1 for the neighbour, whether it turns the motor, (rows, joints) ratios)."""
        forms = ((-1, False), (1, False), (-1, True), (1, True))
        found = [
            (side, turns, values["ratio"] * (values["form"] == form))
            for form, (side, turns) in enumerate(forms)
        ]
        return [each for each in found if each[2].any()]


class Backlash(Effect):
    """Backlash of the gear: the link moves freely within a gap."""

    id = "backlash"
    family = "transmission"
    law = "effort = tooth_stiffness (|motor - link| - gap / 2) for |motor - link| > gap / 2, else 0"
    source = "Nordin, Gutman, Automatica 38 (2002): controlling systems with backlash"
    remembers = True
    parameters = (
        Parameter("gap", "position", 0.0, 0.0, 0.4, (0.01, 0.025, 0.06), meaning="backlash"),
        # Teeth are stiff: the parameter is the reciprocal.
        Parameter(
            "tooth_compliance", "one", None, 0.0, 0.02, (0.002,), "compliance",
            ("tooth_stiffness", "stiffness"), meaning="tooth stiffness",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "dead_zone": "move the link by hand with the motor held: only backlash gives free play",
        "coulomb_friction": "move the link by hand with the motor held: only backlash gives free "
        "play",
        "joint_elasticity": "repeat the recording with two payloads: a gap does not grow with the "
        "load",
        # Where the load always presses the teeth to one side, a gap is a constant offset.
        **dict.fromkeys(
            ("joint_spring", "encoder_bias", "asymmetric_friction", "external_force"),
            "move the joint to a pose where its load has the other sign: only a gap jumps",
        ),
    }
    generalizes = frozenset({"joint_elasticity"})

    def holds(self, effect: str) -> Mapping[str, str]:
        """A compliant gear's compliance becomes that of its teeth."""
        return {"compliance": "tooth_compliance"} if effect == "joint_elasticity" else {}

    def separates(self, values: Values) -> NDArray[np.bool_]:
        return values["gap"] > 0.0

    def gear(self, gear: Gear, world: World, values: Values) -> None:
        gear.gap = gear.gap + values["gap"]
        gear.add_compliance(
            self.separates(values), values["tooth_compliance"], None,
            world.motor_armature, world.link_inertia, world.timestep,
        )  # fmt: skip

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        return PoseShift(-0.5, "side") if parameter in ("", "gap") else None


_LINK_ERRORS = (-0.4, -0.2, 0.2, 0.4, 0.8)
"""Relative errors of a link's mass and inertia to try behind an elastic transmission."""


class JointElasticity(Effect):
    """An elastic transmission (gear, belt): motor and link can oscillate against each other."""

    id = "joint_elasticity"
    family = "transmission"
    law = (
        "effort = stiffness (motor - link) + damping d(motor - link)/dt; "
        "damping = damping_time stiffness"
    )
    source = "Spong, J. Dyn. Syst. Meas. Control 109 (1987): elastic joint robots"
    remembers = True
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the stiffness.
        Parameter(
            "compliance", "one", 0.0, 0.0, 20.0, (0.02, 0.06, 0.15, 0.4), "compliance",
            ("stiffness", "stiffness"), meaning="transmission stiffness",
        ),
        Parameter(
            "damping_time", "time", None, 0.0, 0.2, (0.004, 0.015),
            meaning="damping divided by stiffness",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "backlash": "repeat the recording with two payloads: only elastic deflection grows with "
        "the load",
        "actuator_lag": "tap the link: only an elastic transmission resonates",
        "controller_gain": "record fast and slow motions: only an elastic transmission resonates",
    }

    def propose(self, at: JointFit) -> Iterable[Start]:
        """Its own starts; beside a fit with it, a heavier link on a stiffer gear.

        Gear and servo are springs in series. The link swings on them at the root of their stiffness
        divided by its inertia. A fit with the model's link finds the compliance of this resonance.
        """
        yield from super().propose(at)
        own = at.present
        if own is None or own["damping_time"] <= 0.0:
            return
        series = own["compliance"] + at.servo_compliance
        for error in _LINK_ERRORS:
            compliance = series / (1.0 + error) - at.servo_compliance
            if compliance > 0.0:
                changed = {**own, "compliance": compliance}
                yield Start(
                    np.array([changed[p.name] for p in self.parameters]),
                    {"inertial_parameters": {"relative_error": error}},
                )

    def separates(self, values: Values) -> NDArray[np.bool_]:
        return values["compliance"] > 0.0

    def gear(self, gear: Gear, world: World, values: Values) -> None:
        gear.add_compliance(
            self.separates(values), values["compliance"], values["damping_time"],
            world.motor_armature, world.link_inertia, world.timestep,
        )  # fmt: skip

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        if unit in (self.parameters[0].unit(kind) for kind in ("hinge", "slide")) and value > 0.0:
            return PoseShift(1.0 / value**2, "load")
        soft = (self.parameters[0].fitted_unit(kind) for kind in ("hinge", "slide"))
        return PoseShift(-1.0, "load") if unit in soft else None
