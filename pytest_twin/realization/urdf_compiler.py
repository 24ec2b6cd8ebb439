"""The ``<mujoco>`` block of a URDF: what it asks of MuJoCo's compiler, done to the robot itself.

MuJoCo reads ``<compiler>``, ``<option>`` and ``<size>`` there. Its corrections of inertias are
part of the robot that its author simulates, so every form of the robot gets them. The folders of
meshes are in :mod:`pytest_twin.realization.files.urdf`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from pytest_twin.realization.node import Node

if TYPE_CHECKING:
    from pytest_twin.realization.urdf import Link

Vector = NDArray[np.float64]

_HONOURED = frozenset(
    {"meshdir", "assetdir", "texturedir", "strippath"}
    | {"balanceinertia", "boundmass", "boundinertia"}
)
# No motion depends on them: visual shapes collide with nothing, links that are welded together
# move as one, URDF's angles are radians for MuJoCo too, and a stated range limits.
_WITHOUT_EFFECT = frozenset(
    {"discardvisual", "fusestatic", "angle", "eulerseq", "coordinate", "usethread", "alignfree"}
)


@dataclass(frozen=True, slots=True)
class UrdfCompiler:
    """What the ``<mujoco>`` block of a URDF states.

    Attributes:
        balance: an inertia that no body can have becomes the mean of its principal moments about
            every axis.
        bound_mass: least mass of a link, kg.
        bound_inertia: least principal moment of a link, kg*m^2.
        option: the ``<option>`` element.
        compiler: the ``<compiler>`` element.
    """

    balance: bool = False
    bound_mass: float = 0.0
    bound_inertia: float = 0.0
    option: Node | None = None
    compiler: Node | None = None

    @staticmethod
    def of(root: Node) -> UrdfCompiler:
        """What the ``robot`` element says.

        Raises:
            ModelError: a bound that is no number.
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
        """The link as MuJoCo's compiler leaves it: bounds first, then the balance."""
        if link.inertial is None:
            return link
        mass = max(link.mass, self.bound_mass)
        moments, axes = np.linalg.eigh(link.inertia)
        wanted = np.maximum(moments, self.bound_inertia) if self.bound_inertia > 0 else moments
        if self.balance and wanted[0] + wanted[1] < wanted[2]:
            wanted = np.full(3, wanted.mean())
        if mass == link.mass and np.array_equal(wanted, moments):
            return link
        return replace(link, mass=mass, inertia=axes @ np.diag(wanted) @ axes.T)

    @property
    def not_honoured(self) -> tuple[str, ...]:
        """Attributes of ``<compiler>`` that change the robot for MuJoCo and are left out here."""
        stated = {} if self.compiler is None else self.compiler.attributes
        return tuple(sorted(set(stated) - _HONOURED - _WITHOUT_EFFECT))

    def option_text(self, **defaults: str) -> str:
        """An MJCF that states the options, those of the URDF above ``defaults``."""
        stated = {**defaults, **({} if self.option is None else self.option.attributes)}
        flags = "" if self.option is None else "".join(map(_text, self.option.children))
        words = "".join(f" {key}={quoteattr(value)}" for key, value in stated.items())
        return f"<mujoco><option{words}>{flags}</option></mujoco>"


def _text(node: Node) -> str:
    words = "".join(f" {key}={quoteattr(value)}" for key, value in node.attributes.items())
    return f"<{node.tag}{words}>{''.join(map(_text, node.children))}</{node.tag}>"
