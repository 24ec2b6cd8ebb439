"""All realizations of one robot, whose properties are tested."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from pytest_twin.checks.poses import Configurations
from pytest_twin.errors import ModelError, SpecError, TwinError
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.properties.form import (
    Form,
    mujoco_form,
    pinocchio_form,
    realization_form,
    reference_form,
    stage_form,
    text_form,
    usd_form,
)
from pytest_twin.properties.tolerances import Tolerances
from pytest_twin.properties.trees import joint_names

_GOLDEN = 0.6180339887498949
"""Golden ratio minus 1: its multiples modulo 1 are spread evenly."""


class Asset:
    """Realizations of one robot; the others are compared with the first.

    Attributes:
        name: name in error messages.
        left_out: realizations that are not available, with the reason.
    """

    def __init__(
        self,
        name: str,
        forms: Sequence[Form],
        tolerances: Tolerances | None = None,
        left_out: Sequence[str] = (),
    ) -> None:
        self.name = name
        self.forms = tuple(forms)
        self.tolerances = tolerances or Tolerances()
        self.left_out = tuple(left_out)
        if not any(form.model is not None for form in forms):
            raise ModelError(
                "no realization that MuJoCo compiles",
                path=name,
                value="; ".join(self.left_out) or None,
                expected="at least one; pytest-twin audit says what the model lacks",
            )

    @property
    def first(self) -> Form:
        """The realization with which the others are compared."""
        return self.forms[0]

    @property
    def others(self) -> tuple[Form, ...]:
        """All realizations but the first."""
        return self.forms[1:]

    @property
    def simulated(self) -> tuple[Form, ...]:
        """Realizations in MuJoCo."""
        return tuple(form for form in self.forms if form.model is not None)

    @cached_property
    def configurations(self) -> Configurations:
        """Independent joints and their limits, from the first realization in MuJoCo."""
        return Configurations(self.simulated[0].model)

    @cached_property
    def rest(self) -> dict[str, float]:
        """Configuration with all independent joints at their reference, rad or m."""
        return self.configurations.complete({}) or {}

    @cached_property
    def generic(self) -> dict[str, float]:
        """A generic configuration, in which no joint has a special value, rad or m."""
        for turn in range(1, 50):
            values = {
                joint: lower + (upper - lower) * ((turn + i) * _GOLDEN % 1.0)
                for i, (joint, (lower, upper)) in enumerate(self.configurations.independent.items())
            }
            found = self.configurations.complete(values)
            if found is not None:
                return found
        return self.rest

    @cached_property
    def carried(self) -> dict[str, float]:
        """Joint -> mass of all bodies that it moves, kg."""
        model = self.simulated[0].model
        return {
            name: float(model.body_subtreemass[int(body)])
            for name, body in zip(joint_names(model), model.jnt_bodyid, strict=True)
        }

    @cached_property
    def velocity(self) -> dict[str, float]:
        """Generic joint velocities, rad/s or m/s."""
        joints = self.first.dynamics.joints
        return {joint: 0.5 + (i * _GOLDEN) % 1.0 for i, joint in enumerate(joints)}

    def shared(self, form: Form) -> tuple[str, ...]:
        """Joints with one degree of freedom in both the first realization and ``form``."""
        theirs = set(form.dynamics.joints)
        return tuple(j for j in self.first.dynamics.joints if j in theirs)

    def factor(self, *forms: Form) -> float:
        """Factor on tolerances, larger than 1 if one realization has single precision."""
        return self.tolerances.single if any(form.single for form in forms) else 1.0


def load_asset(
    path: Path,
    *,
    tolerances: Tolerances | None = None,
    usd: bool | Path = True,
    packages: Mapping[str, Path] | None = None,
    accept: Iterable[str] = (),
) -> Asset:
    """Load all realizations of a robot.

    - ``twin.yaml``: each realization as it is simulated, and its source in Pinocchio.
    - a URDF: its own values, MuJoCo, Pinocchio and USD, each through its own importer.
    - an MJCF: MuJoCo and Pinocchio.

    Args:
        usd: for a URDF: an existing stage; or whether to create one, if the extra ``usd`` is
            installed.
        packages: ROS package -> its folder.
        accept: accepted repairs of a URDF, ``inertia-repair:<link>``.

    Raises:
        TwinError: a file that cannot be read as a robot.
    """
    if path.suffix in (".yaml", ".yml"):
        return _of_twin(path, tolerances)
    if not path.is_file():
        raise SpecError("no such file", path=path, expected="twin.yaml, a URDF or an MJCF")
    from pytest_twin.formats import xml

    if xml.parse(path).tag == "robot":
        return _of_urdf(path, tolerances, usd, packages or {}, list(accept))
    return _of_mjcf(path, tolerances)


def _of_urdf(
    path: Path,
    tolerances: Tolerances | None,
    usd: bool | Path,
    packages: Mapping[str, Path],
    accept: list[str],
) -> Asset:
    from pytest_twin.asset.normalize import normalize
    from pytest_twin.formats.declared_inputs import DeclaredInputs, declaring
    from pytest_twin.realization.files.locate import locate
    from pytest_twin.realization.usd import UsdMissingError

    left_out: list[str] = []
    with temporary_folder() as folder:
        with declaring(DeclaredInputs(packages=packages)):
            located = locate(path)
        made = normalize(path, folder, located=located, accept=accept)
        for flag in made.flags:
            if flag.patch and flag.critical:
                raise ModelError(
                    f"{flag.why} ({flag.value})",
                    path=path,
                    line=flag.line,
                    where=flag.where,
                    expected=f"another value, or its repair accepted: accept=[{flag.patch!r}]",
                )
        forms = [text_form(made.urdf), mujoco_form(made.urdf), pinocchio_form(made.urdf)]
        if usd:
            try:
                forms.append(usd_form(made.urdf) if usd is True else stage_form(usd))
            except UsdMissingError as error:
                left_out.append(str(error))
    return Asset(path.name, forms, tolerances, left_out)


def _of_mjcf(path: Path, tolerances: Tolerances | None) -> Asset:
    from pytest_twin.realization import load

    forms, left_out = _pair(load(path), "MuJoCo", "Pinocchio", complete=True)
    return Asset(path.name, forms, tolerances, left_out)


def _of_twin(path: Path, tolerances: Tolerances | None) -> Asset:
    from pytest_twin.realization import load
    from pytest_twin.twin import load_twin

    twin = load_twin(path)
    forms: list[Form] = []
    left_out: list[str] = []
    for ref in twin.realizations.values():
        realization = load(ref.file, twin=twin, name=ref.name)
        made, missing = _pair(realization, ref.name, f"Pinocchio of {ref.name}", complete=not forms)
        forms += made
        left_out += missing
    if not forms:
        raise twin.error(
            "realizations",
            "no realization whose properties could be tested",
            expected="at least one that Pinocchio or MuJoCo loads",
        )
    return Asset(twin.name, forms, tolerances, left_out)


def _pair(
    realization: Any, name: str, reference: str, *, complete: bool
) -> tuple[list[Form], list[str]]:
    forms = [realization_form(realization, name, complete=complete)]
    try:
        forms.append(reference_form(realization, reference, complete=complete))
    except TwinError as error:
        return forms, [f"{reference} is left out: {error}"]
    return forms, []
