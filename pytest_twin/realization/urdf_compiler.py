"""Settings for MuJoCo's compiler in the ``<mujoco>`` block of a URDF, applied to the robot.

MuJoCo reads ``<compiler>``, ``<option>`` and ``<size>`` in this block. The author of the robot
simulates it with the corrected inertias, so that all realizations get the corrections. The folders
of meshes are handled in :mod:`pytest_twin.realization.files.urdf`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from pytest_twin.realization.node import Node

if TYPE_CHECKING:
    from pytest_twin.realization.urdf import Link


_APPLIED = frozenset(
    {"meshdir", "assetdir", "texturedir", "strippath"}
    | {"balanceinertia", "boundmass", "boundinertia"}
)
# Attributes that do not change the motion: visual shapes do not collide, fixed links move together,
# MuJoCo reads the angles of a URDF in rad, and a stated range is a limit.
_WITHOUT_EFFECT = frozenset(
    {"discardvisual", "fusestatic", "angle", "eulerseq", "coordinate", "usethread", "alignfree"}
)


@dataclass(frozen=True, slots=True)
class UrdfCompiler:
    """Settings in the ``<mujoco>`` block of a URDF.

    Attributes:
        balances_inertia: whether the principal moments of an inconsistent inertia are replaced by
            their mean.
        bound_mass: smallest mass of a link, kg.
        bound_inertia: smallest principal moment of a link, kg*m^2.
        option: the ``<option>`` element, or None.
        compiler: the ``<compiler>`` element, or None.
    """

    balances_inertia: bool = False
    bound_mass: float = 0.0
    bound_inertia: float = 0.0
    option: Node | None = None
    compiler: Node | None = None

    @staticmethod
    def of(root: Node) -> UrdfCompiler:
        """Read the settings below the ``robot`` element.

        Raises:
            ModelError: a bound that is not a number.
        """
        block = root.find("mujoco")
        if block is None:
            return UrdfCompiler()
        compiler, option = block.find("compiler"), block.find("option")
        if compiler is None:
            return UrdfCompiler(option=option)
        return UrdfCompiler(
            compiler.attributes.get("balanceinertia", "").strip() == "true",
            compiler.number("boundmass", 0.0, unit="kg"),
            compiler.number("boundinertia", 0.0, unit="kg*m^2"),
            option,
            compiler,
        )

    def corrected(self, link: Link) -> Link:
        """The link with the corrections of MuJoCo's compiler: bounds first, then the balance."""
        if link.inertial is None:
            return link
        mass = max(link.mass, self.bound_mass)
        moments, axes = np.linalg.eigh(link.inertia)
        wanted = np.maximum(moments, self.bound_inertia) if self.bound_inertia > 0 else moments
        if self.balances_inertia and wanted[0] + wanted[1] < wanted[2]:
            wanted = np.full(3, wanted.mean())
        if mass == link.mass and np.array_equal(wanted, moments):
            return link
        return replace(link, mass=mass, inertia=axes @ np.diag(wanted) @ axes.T)

    @property
    def not_applied(self) -> tuple[str, ...]:
        """Attributes of ``<compiler>`` that change the robot in MuJoCo and are not applied."""
        stated = {} if self.compiler is None else self.compiler.attributes
        return tuple(sorted(set(stated) - _APPLIED - _WITHOUT_EFFECT))

    def option_text(self, **defaults: str) -> str:
        """MJCF text with the simulation options: those of the URDF, else ``defaults``."""
        stated = {**defaults, **({} if self.option is None else self.option.attributes)}
        flags = "" if self.option is None else "".join(map(_text, self.option.children))
        words = "".join(f" {key}={quoteattr(value)}" for key, value in stated.items())
        return f"<mujoco><option{words}>{flags}</option></mujoco>"


def _text(node: Node) -> str:
    words = "".join(f" {key}={quoteattr(value)}" for key, value in node.attributes.items())
    return f"<{node.tag}{words}>{''.join(map(_text, node.children))}</{node.tag}>"
