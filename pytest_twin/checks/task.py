"""Task: a user's Python function of a realization, with declared outputs."""

from __future__ import annotations

import contextlib
import functools
import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import spec_error
from pytest_twin.checks.files import find_file
from pytest_twin.checks.schemas import array, choice, mapping, table, text
from pytest_twin.checks.task_modules import declared_modules, load_file
from pytest_twin.dependency import Structure
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden
from pytest_twin.units import SI_UNITS, Quantity, parse_quantity

if TYPE_CHECKING:
    from types import ModuleType

    from pytest_twin.realization import Realization

_NAME: Mapping[str, Any] = {"type": "string", "minLength": 1}
_LARGEST_OUTPUT = 10_000
"""Largest number of values of one output."""


class Task(Check):
    """Outputs that a user's function computes from a realization.

    The function runs with the rights of the user who runs pytest, unless goldens are confined. It
    is called ``function(realization, **stimulus)`` in the child process and returns
    a mapping from each declared output to a number or a list of numbers, in SI units.

    ``values``: output -> number or list.
    """

    kind: ClassVar[str] = "task"
    dynamic: ClassVar[bool] = True
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy")
    tolerances: ClassVar[Mapping[str, str]] = {}
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "function": text(
                    "'tasks.py:pick_and_place', with a file relative to the twin's folder or to "
                    "one of its roots, or 'package.module:function' of an installed package. The "
                    "function has your rights, unless pytest runs with --twin-confine.",
                    pattern="^[^:]+:[A-Za-z_][A-Za-z0-9_]*$",
                ),
                "files": array(
                    _NAME,
                    "Other files that the result depends on: every module of the twin that the "
                    "function imports, and the tables that it reads. The paths are relative to "
                    "the twin's folder or to one of its roots.",
                    uniqueItems=True,
                ),
                "outputs": mapping(
                    table(
                        {
                            "unit": choice(list(SI_UNITS), "SI unit; 1 without a unit."),
                            "tolerance": text(
                                "Largest error of each number, such as '2 mm'.", minLength=1
                            ),
                        },
                        required=["unit", "tolerance"],
                    ),
                    "Output of the function -> its SI unit and its tolerance.",
                    minProperties=1,
                ),
            },
            required=["function", "outputs"],
        ),
        "stimulus": {
            "type": "object",
            "description": "Keyword arguments of the function.",
            "propertyNames": {"pattern": "^[A-Za-z_][A-Za-z0-9_]*$"},
        },
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts of the realization, the function's file (or the version of its
        distribution), and the files that the spec declares."""
        parts = set(structure.everything())
        place, _, _ = golden.target["function"].partition(":")
        if place.endswith(".py"):
            parts.add(f"file:{place}")
        else:
            parts |= {f"library:{name}" for name in _distributions(place)}
        parts |= {f"file:{name}" for name in golden.target.get("files", ())}
        parts |= {f"calibration:{joint}" for joint in structure.joint_body}
        # The function may use any variant.
        parts |= {"controller:*", "payload:*", "calibration:*", "record:*"}
        parts.add("base:calibration")
        return parts

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing, because the robot's task is unknown."""
        raise NothingToProposeError("a task is code of your own; docs/kinds/task.md has an example")

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Call the function, and check its result against the declared outputs."""
        outputs = golden.target["outputs"]
        with _function(golden, realization) as function:
            try:
                returned = function(realization, **golden.stimulus)
            except TypeError as error:
                if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                    raise
                raise spec_error(
                    golden,
                    "stimulus",
                    f"the function cannot be called with these arguments: {error}",
                    expected="function(realization, **stimulus)",
                ) from error
        progress(1.0)
        if not isinstance(returned, Mapping):
            raise _refuse(
                golden, "the function did not return a mapping", type(returned).__name__, outputs
            )
        for problem, names in (
            ("outputs that the function did not return", outputs.keys() - returned.keys()),
            ("outputs that the spec does not declare", returned.keys() - outputs.keys()),
        ):
            if names:
                raise _refuse(golden, problem, ", ".join(sorted(map(str, names))), outputs)
        return Observation({name: _numbers(golden, name, returned[name]) for name in outputs})

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare each number with the recorded one."""
        expected = golden.expected or {}
        measures: list[Measure] = []
        for name, declared in golden.target["outputs"].items():
            field = f"target.outputs.{name}.tolerance"
            unit = declared["unit"]
            try:
                bound = parse_quantity(declared["tolerance"], (unit,))
            except SpecError as error:
                raise spec_error(
                    golden, field, error.problem, value=error.value, expected=error.expected
                ) from None
            if name not in expected:
                raise spec_error(
                    golden,
                    "expected",
                    f"no recorded value of output {name!r}",
                    expected="pytest --twin-update",
                )
            now, then = observation.values[name], expected[name]
            measures += _output_measures(golden, name, now, then, bound)
        return measures


def _output_measures(
    golden: Golden, name: str, now: Any, then: Any, bound: Quantity
) -> Iterator[Measure]:
    as_list, was_list = isinstance(now, list), isinstance(then, list)
    if as_list != was_list or (as_list and len(now) != len(then)):
        raise spec_error(
            golden,
            f"expected.{name}",
            "the function's output has another length than the recorded one",
            value=len(now) if as_list else "a number",
            expected=f"{len(then)} numbers" if was_list else "a number",
        )
    function = golden.target["function"].rpartition(":")[2]
    pairs = zip(now, then, strict=True) if as_list else [(now, then)]
    for i, (measured, recorded) in enumerate(pairs):
        subject = f"{function}[{i}]" if as_list else function
        yield Measure.of_difference(name, subject, (measured, float(recorded)), bound)


def _refuse(golden: Golden, problem: str, value: str, outputs: Mapping[str, Any]) -> SpecError:
    return spec_error(
        golden, "target.outputs", problem, value=value, expected=", ".join(sorted(outputs))
    )


def _numbers(golden: Golden, name: str, value: Any) -> float | list[float]:
    """Return ``value`` as a number or list of numbers for JSON.

    Raises:
        SpecError: not a number or list of numbers, too many, or not finite.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    values = list(value) if isinstance(value, list | tuple) else [value]
    place = f"target.outputs.{name}"
    if len(values) > _LARGEST_OUTPUT:
        raise spec_error(
            golden,
            place,
            "too many numbers",
            value=len(values),
            expected=f"at most {_LARGEST_OUTPUT}",
        )
    for i, item in enumerate(values):
        where = f"{place}[{i}]" if isinstance(value, list | tuple) else place
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise spec_error(
                golden,
                where,
                "the function did not return a number",
                value=type(item).__name__,
                expected="a number or a list of numbers",
            )
        if not math.isfinite(item):
            raise spec_error(
                golden,
                where,
                "the function returned a number that is not finite",
                value=str(item),
                expected="a finite number",
            )
    numbers = [float(item) for item in values]
    return numbers if isinstance(value, list | tuple) else numbers[0]


@functools.cache
def _distributions(module: str) -> tuple[str, ...]:
    """Return the installed distributions that contain the top package of ``module``."""
    return tuple(metadata.packages_distributions().get(module.partition(".")[0], ()))


@contextlib.contextmanager
def _function(golden: Golden, realization: Realization) -> Iterator[Callable[..., Any]]:
    """Load the function in a context in which the declared modules are importable."""
    place, _, name = golden.target["function"].partition(":")
    field = "target.function"
    with contextlib.ExitStack() as stack:
        if place.endswith(".py"):
            if realization.twin is None:
                raise SpecError(
                    "a golden with a task in a file belongs to a twin",
                    path=golden.path,
                    expected="twin.yaml in a folder above it",
                )
            twin = realization.twin
            path = find_file(golden, field, place, twin)
            files = {
                find_file(golden, "target.files", name, twin): name
                for name in golden.target.get("files", ())
            }
            stack.enter_context(declared_modules(golden, path, files))
            module = load_file(path)
        else:
            module = _installed_module(golden, field, place)
        found: Callable[..., Any] | None = getattr(module, name, None)
        if not callable(found):
            raise spec_error(
                golden,
                field,
                f"no function of this name in {place}",
                value=name,
                expected="a function that this module defines",
            )
        yield found


def _installed_module(golden: Golden, field: str, place: str) -> ModuleType:
    expected = "an installed module, or a file ending in .py"
    if not _distributions(place):
        raise spec_error(
            golden,
            field,
            "no installed distribution brings this module",
            value=place,
            expected=expected,
        )
    try:
        return importlib.import_module(place)
    except ImportError as error:
        raise spec_error(
            golden, field, f"cannot be imported: {error}", value=place, expected=expected
        ) from error
