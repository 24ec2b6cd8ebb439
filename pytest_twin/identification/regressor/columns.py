"""Parameters of the inverse dynamics: names, symbols from the literature, units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pytest_twin.effects.base import Quantity, si_unit
from pytest_twin.realization.inverse_dynamics import INERTIAL

_SECOND_MOMENTS = frozenset(name for name in INERTIAL if name.startswith("I"))
_JOINT: tuple[tuple[str, str, Quantity], ...] = (
    # (effect of the catalogue, symbol of the literature, quantity of its coefficient)
    ("armature", "Ia", "inertia"),
    ("viscous_friction", "fv", "damping"),
    ("coulomb_friction", "fs", "effort"),
    ("effort_bias", "off", "effort"),
)
_IN_CURRENT = ["A*s^2/rad", "A*s/rad", "A", "A"]
"""Units of drive parameters if the effort is a current; per m for prismatic joints."""
_COUPLED: tuple[tuple[str, str, Quantity], ...] = (
    ("coupled_armature", "Iam", "inertia"),
    ("coupled_viscous_friction", "fvm", "damping"),
    ("coupled_coulomb_friction", "fsm", "effort"),
)
_MEANING = {
    "armature": "armature (reflected rotor inertia)",
    "viscous_friction": "viscous friction",
    "coulomb_friction": "Coulomb friction",
    "effort_bias": "constant effort",
    "effort_scale": "recorded effort per unit of the model's effort",
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
        kind: ``Ixx`` to ``m`` (see ``INERTIAL``), or an effect: ``armature``, ``viscous_friction``,
            ``coulomb_friction``, ``effort_bias``; ``coupled_...`` where two joints share a motor.
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
        if self.partner:
            return f"{_MEANING[self.kind]} '{self.partner}' and '{self.joint}'"
        link = f"of the link of '{self.joint}'" if self.is_inertial else f"of '{self.joint}'"
        return f"{_MEANING[self.kind]} {link}"

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
            units = [si_unit(quantity, slide) for _, _, quantity in _JOINT]
            if joint in unscaled:
                effort = si_unit("effort", slide)
                found.append(Column(joint, "effort_scale", f"ks{number}", f"A/({effort})"))
                units = _IN_CURRENT
            found += [
                Column(joint, kind, f"{symbol}{number}", unit)
                for (kind, symbol, _), unit in zip(_JOINT, units, strict=True)
            ]
    for motor in shared:
        number = order.index(motor.joint) + 1
        slide = slides[joints.index(motor.joint)]
        found += [
            Column(motor.joint, kind, f"{symbol}{number}", si_unit(quantity, slide), motor.other)
            for kind, symbol, quantity in _COUPLED
        ]
    return tuple(found)


def _inertial_unit(kind: str) -> str:
    if kind == "m":
        return "kg"
    return "kg*m^2" if kind in _SECOND_MOMENTS else "kg*m"
