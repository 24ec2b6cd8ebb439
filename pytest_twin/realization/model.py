"""A realization: the model of a robot in one simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mujoco

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import mjcf, patch
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.twin import Twin

if TYPE_CHECKING:
    from pytest_twin.dependency import Part, Structure
    from pytest_twin.realization.reference import Reference


class Realization(NamedModel):
    """The model of a robot in one simulator, with its variants and its Pinocchio reference."""

    # -- variants

    def variant(self, controller: str | None = None, payload: str | None = None) -> Realization:
        """The same robot with a controller and a payload of the twin.

        Args:
            controller: id of the controller, None for the nominal one.
            payload: id of the payload, None for none.

        Raises:
            SpecError: the twin has no such id, or the model lacks an element that it names.
            ModelError: the result does not compile.
        """
        if controller is None and payload is None:
            return self
        if self.twin is None:
            raise SpecError(
                "a model without twin.yaml has no controllers or payloads",
                path=self.path,
                value=", ".join(name for name in (controller, payload) if name is not None),
                expected="a twin.yaml with controllers and payloads; pytest-twin init writes one",
            )
        twin = self.twin
        spec = self.spec.copy()
        if controller is not None:
            actuators = _declared_table(twin, "controllers", controller)
            for name, change in actuators.items():
                where = f"controllers.{controller}.{name}"
                patch.patch_actuator(spec, name, change, where=where, refuse=twin.error)
        if payload is not None:
            bodies = _declared_table(twin, "payloads", payload)
            patch.apply_payload(spec, bodies, where=f"payloads.{payload}", refuse=twin.error)
        try:
            model, warned = mjcf.compile_spec(spec)
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            raise ModelError(
                f"MuJoCo refuses the variant: {' '.join(str(error).split())}",
                path=twin.path,
                where=", ".join(
                    f"{table}.{key}"
                    for table, key in (("controllers", controller), ("payloads", payload))
                    if key is not None
                ),
            ) from None
        said = [f"{self.path}: MuJoCo warns of the variant: {words}" for words in warned]
        return Realization(
            name=self.name,
            path=self.path,
            spec=spec,
            model=model,
            source=replace(self.source, notes=(*self.source.notes, *said)),
            twin=twin,
            controller=controller,
            payload=payload,
            simulator=self.simulator,
        )

    # -- other views

    @cached_property
    def structure(self) -> Structure:
        """Kinematic tree, actuators and couplings, for the dependency map."""
        from pytest_twin.realization.features import reading

        return reading.model_structure(self.model, self.name, self.parts)

    @cached_property
    def parts(self) -> dict[str, Part]:
        """All parts that a check can depend on, by part id."""
        from pytest_twin.realization.features import reading

        return reading.parts(self)

    @cached_property
    def reference(self) -> Reference:
        """The same robot in Pinocchio."""
        from pytest_twin.realization.reference import Reference

        return Reference(self)


def _declared_table(twin: Twin, table: str, key: str) -> Mapping[str, Any]:
    declared = getattr(twin, table)
    if key not in declared:
        raise twin.error(table, f"no {key!r} there", expected=patch.suggest(key, declared))
    found: Mapping[str, Any] = declared[key]
    return found
