"""Parameters of the inverse dynamics: names, symbols from the literature, units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pytest_twin.effects import Effect, catalogue, in_order_of_fields
from pytest_twin.effects.base import Quantity, si_unit
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.realization.inverse_dynamics import INERTIAL

_SECOND_MOMENTS = frozenset(name for name in INERTIAL if name.startswith("I"))
_COUPLED: tuple[tuple[str, str, Quantity], ...] = (
    ("coupled_armature", "Iam", "inertia"),
    ("coupled_viscous_friction", "fvm", "damping"),
    ("coupled_coulomb_friction", "fsm", "effort"),
)
_MEANING = {
    EffortBias.id: "constant effort",
    EffortScale.id: "recorded effort per unit of the model's effort",
    "coupled_armature": "armature that a shared motor couples into",
    "coupled_viscous_friction": "viscous friction that a shared motor couples into",
    "coupled_coulomb_friction": "Coulomb friction of the motor shared by",
    "m": "mass",
    **{f"m{axis}": f"first moment along {axis}" for axis in "xyz"},
    **{name: f"second moment {name[1:]} about the joint" for name in _SECOND_MOMENTS},
}


@dataclass(frozen=True, slots=True)
class SharedMotor:
    """A motor that two joints share. It rotates by ``own + ratio * other``, times the gear ratio.

    Attributes:
        joint: joint that the motor is named after.
        other: joint whose motion rotates the motor too.
        ratio: 1 if the motor rotates with the sum of both joints, -1 with their difference.
    """

    joint: str
    other: str
    ratio: float = 1.0


@dataclass(frozen=True, slots=True)
class Column:
    """One parameter in which the joint efforts are linear.

    Attributes:
        joint: joint that it belongs to; of an inertial parameter, the joint that moves the link.
        kind: ``Ixx`` to ``m`` (see ``INERTIAL``), or one of :func:`drive_effects`;
            ``coupled_...`` where two joints share a motor.
        symbol: symbol in the literature, such as ``Izz1``, ``Ia1``, ``fv1``, ``fs1``.
        unit: unit of its value.
        partner: other joint of a shared motor, else empty.
    """

    joint: str
    kind: str
    symbol: str
    unit: str
    partner: str = ""

    @property
    def name(self) -> str:
        """Name in ``identification.json``, ``JOINT.KIND``."""
        return f"{self.joint}.{self.kind}"

    @property
    def words(self) -> str:
        """Description of the parameter, as a noun phrase."""
        meaning = _MEANING.get(self.kind) or catalogue()[self.kind].parameters[0].meaning
        if self.partner:
            return f"{meaning} '{self.partner}' and '{self.joint}'"
        link = f"of the link of '{self.joint}'" if self.is_inertial else f"of '{self.joint}'"
        return f"{meaning} {link}"

    @property
    def is_inertial(self) -> bool:
        """Whether the parameter belongs to a link and not to a drive."""
        return self.kind in INERTIAL


def columns(
    joints: Sequence[str],
    links: Sequence[str],
    slides: Sequence[bool],
    shared: Sequence[SharedMotor] = (),
    unscaled: Sequence[str] = (),
) -> tuple[Column, ...]:
    """Return all columns: for each joint its link and drive, then links of other joints.

    Args:
        joints: names in the order of the efforts; symbols count them from 1.
        links: joints whose links are included; links of other joints come last.
        slides: whether each joint is prismatic.
        shared: motors that two joints share.
        unscaled: joints whose recorded effort is in A and not in N*m.
    """
    found = []
    order = [*joints, *(link for link in links if link not in joints)]
    for number, joint in enumerate(order, 1):
        if joint in links:
            found += [
                Column(joint, kind, f"{kind}{number}", _inertial_unit(kind)) for kind in INERTIAL
            ]
        if joint in joints:
            slide = slides[joints.index(joint)]
            if joint in unscaled:
                effort = si_unit("effort", slide)
                found.append(Column(joint, EffortScale.id, f"ks{number}", f"A/({effort})"))
            found += [
                Column(
                    joint, effect.id, f"{effect.regressor_symbol}{number}",
                    _unit_of_drive(effect.parameters[0].quantity, slide, joint in unscaled),
                )
                for effect in drive_effects()
            ]  # fmt: skip
    for motor in shared:
        number = order.index(motor.joint) + 1
        slide = slides[joints.index(motor.joint)]
        found += [
            Column(motor.joint, kind, f"{symbol}{number}", si_unit(quantity, slide), motor.other)
            for kind, symbol, quantity in _COUPLED
        ]
    return tuple(found)


def drive_effects() -> list[Effect]:
    """Return the effects in which the effort of a joint's drive is linear.

    Those of the model's joints come first, in the order of the literature: Ia, fv, fs.
    """
    return in_order_of_fields(e for e in catalogue().values() if e.regressor_symbol)


def _unit_of_drive(quantity: Quantity, slide: bool, in_current: bool) -> str:
    """Unit of a drive's parameter; with A for N*m or N if the recorded effort is a current.

    An inertia is an effort per acceleration.
    """
    if not in_current:
        return si_unit(quantity, slide)
    per_motion = {"inertia": ("A*s^2/rad", "A*s^2/m")}.get(quantity)
    if per_motion is not None:
        return per_motion[slide]
    return si_unit(quantity, slide).replace("N" if slide else "N*m", "A", 1)


def _inertial_unit(kind: str) -> str:
    if kind == "m":
        return "kg"
    return "kg*m^2" if kind in _SECOND_MOMENTS else "kg*m"
