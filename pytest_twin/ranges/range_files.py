"""Read randomization ranges of other tools; their code is never executed.

A file is a ``ranges.json``, a table of ``NAME: [low, high]``, or events of Isaac Lab or mjlab as
YAML or Python. Of a Python file only the syntax tree is read.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pytest_twin.effects import mjcf_fields
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.errors import FormatError
from pytest_twin.formats import yaml
from pytest_twin.formats.paths import decode_text, read_bytes

_MOST_BYTES = 4 * 2**20
"""Largest size of a file of ranges."""
_DEEPEST = 40
"""Largest nesting depth that is read."""
_EVENT_CLASSES = frozenset({"EventTerm", "EventTermCfg", "EventTermConfig"})
_EXPECTED = (
    "ranges.json, a table NAME: [low, high], or events of Isaac Lab or mjlab as .yaml or .py"
)


@dataclass(frozen=True, slots=True)
class Term:
    """Randomization by one parameter of one event.

    Attributes:
        kinds: kinds of the quantities that it sets, such as ``coulomb_friction``; for a plain table
            the whole name.
        names: patterns of joint or body names; None for all.
        numbers: the two numbers of the distribution.
        operation: use of a draw: ``abs`` sets the value, ``scale`` multiplies, ``add`` adds.
        distribution: ``uniform``, ``log_uniform`` or ``gaussian`` (mean and standard deviation).
        where: place in the file.
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...] | None
    numbers: tuple[float, float]
    operation: Literal["abs", "scale", "add"]
    distribution: str
    where: str


_FUNCTIONS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    # Isaac Lab: one pair of numbers sets static, dynamic and viscous friction.
    "randomize_joint_parameters": {
        "friction_distribution_params": ("frictionloss", "damping"),
        "armature_distribution_params": ("armature",),
    },
    "randomize_rigid_body_mass": {"mass_distribution_params": ("mass",)},
    # mjlab
    "joint_friction": {"ranges": ("frictionloss",)},
    "dof_frictionloss": {"ranges": ("frictionloss",)},
    "joint_damping": {"ranges": ("damping",)},
    "dof_damping": {"ranges": ("damping",)},
    "joint_armature": {"ranges": ("armature",)},
    "dof_armature": {"ranges": ("armature",)},
    # This one has the name of the effect.
    EncoderBias.id: {"bias_range": (EncoderBias.id,)},
    "body_mass": {"ranges": ("mass",)},
}
"""Function of an event -> its parameter -> fields of a joint that it sets, or kinds of other
quantities."""
_OPERATION = {EncoderBias.id: "abs", "body_mass": "scale", "randomize_rigid_body_mass": "abs"}
"""Function -> default operation; all others set the value."""


def read_ranges(path: Path) -> tuple[list[Term], list[str]]:
    """Return the terms of a file, and one line for each part that is not compared.

    Raises:
        PathError: the file does not exist or is a link.
        LimitError: the file is too large.
        FormatError: the file has none of the known formats.
    """
    suffix = path.suffix.lower()
    skipped: list[str] = []
    if suffix == ".py":
        terms = list(_of_events(_python_events(path, skipped), skipped))
    elif suffix in (".json", ".yaml", ".yml"):
        data = _json(path) if suffix == ".json" else yaml.load(path).data
        if not isinstance(data, Mapping):
            raise FormatError("no table of ranges", path=path, expected=_EXPECTED)
        terms = _of_table(data, skipped)
    else:
        raise FormatError("not a type of file that can be compared", path=path, value=suffix,
                          expected=_EXPECTED)  # fmt: skip
    if not terms:
        why = f" ({skipped[0]})" if skipped else ""
        raise FormatError(f"it states no range that can be compared{why}", path=path,
                          expected=_EXPECTED)  # fmt: skip
    return terms, skipped


def _json(path: Path) -> Any:
    try:
        return json.loads(decode_text(read_bytes(path, _MOST_BYTES), path))
    except (ValueError, RecursionError):
        raise FormatError("not JSON", path=path, expected=_EXPECTED) from None


def _of_table(data: Mapping[str, Any], skipped: list[str]) -> list[Term]:
    if "quantities" in data:
        return [
            term
            for one in _list(data["quantities"])
            if isinstance(one, Mapping)
            and (term := _plain_range(str(one.get("name")), one.get("range"), skipped)) is not None
        ]
    events = list(_mapped_events(data, ""))
    if events:
        return list(_of_events(events, skipped))
    found = []
    for name, value in data.items():
        term = _plain_range(str(name), value, skipped)
        if term is not None:
            found.append(term)
    return found


def _plain_range(name: str, value: Any, skipped: list[str]) -> Term | None:
    """Return the term of one range; None with a line in ``skipped`` if it is no range."""
    numbers = _pair(value)
    if numbers is None or numbers[0] > numbers[1]:
        skipped.append(f"{name}: {'not two numbers' if numbers is None else _descends(numbers)}")
        return None
    return Term((name,), None, numbers, "abs", "uniform", name)


def _descends(numbers: tuple[float, float]) -> str:
    return f"its lower end {numbers[0]:g} is above its upper end {numbers[1]:g}"


def _mapped_events(data: Mapping[str, Any], where: str, depth: int = 0) -> Iterator[dict[str, Any]]:
    """Yield tables with a function and parameters, at any depth."""
    if "func" in data and isinstance(data.get("params"), Mapping):
        name = str(data["func"]).replace(":", ".").split(".")[-1]
        yield {"func": name, "params": data["params"], "where": where}
        return
    for key, value in data.items():
        if isinstance(value, Mapping) and depth < _DEEPEST:
            yield from _mapped_events(value, f"{where}.{key}" if where else str(key), depth + 1)


def _python_events(path: Path, skipped: list[str]) -> list[dict[str, Any]]:
    """Return calls of event classes in a Python file."""
    text = decode_text(read_bytes(path, _MOST_BYTES), path)
    try:
        tree = ast.parse(text, filename=path.name)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = getattr(error, "lineno", None)
        raise FormatError("not Python", path=path, line=line, expected=_EXPECTED) from None
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or _last_name(node.func) not in _EVENT_CLASSES:
            continue
        words = {one.arg: one.value for one in node.keywords if one.arg is not None}
        function, params = words.get("func"), words.get("params")
        where = f"line {node.lineno}"
        if function is None or not isinstance(params, ast.Dict):
            skipped.append(f"{where}: an event without literal parameters")
            continue
        values = {}
        for key, value in zip(params.keys, params.values, strict=True):
            if isinstance(key, ast.Constant):
                values[str(key.value)] = _literal(value)
        found.append({"func": _last_name(function), "params": values, "where": where})
    return found


def _last_name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _literal(node: ast.expr) -> Any:
    """Return a literal, or the keywords of a call such as ``SceneEntityCfg(...)``; else None."""
    if isinstance(node, ast.Call):
        return {one.arg: _literal(one.value) for one in node.keywords if one.arg is not None}
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None


def _of_events(events: Sequence[Mapping[str, Any]], skipped: list[str]) -> Iterator[Term]:
    for event in events:
        function, params, where = event["func"], event["params"], event["where"]
        known = _FUNCTIONS.get(function)
        if known is None:
            skipped.append(f"{where}: {function} sets nothing that the ranges have")
            continue
        operation = params.get("operation", _OPERATION.get(function, "abs"))
        distribution = params.get("distribution", "uniform")
        if operation not in ("abs", "scale", "add") or not isinstance(distribution, str):
            skipped.append(f"{where}: {function}: a custom operation or distribution")
            continue
        target = params.get("asset_cfg")
        target = target if isinstance(target, Mapping) else {}
        names = target.get("joint_names", target.get("body_names"))
        for key, kinds in known.items():
            if params.get(key) is None:
                continue
            numbers = _pair(params[key])
            if numbers is None:
                skipped.append(f"{where}: {function}: {key} is not two numbers")
                continue
            if distribution != "gaussian" and numbers[0] > numbers[1]:
                skipped.append(f"{where}: {function}: {key}: {_descends(numbers)}")
                continue
            of_field = {field: effect for effect, field in mjcf_fields().items()}
            quantities = tuple(of_field.get(kind, kind) for kind in kinds)
            yield Term(quantities, _patterns(names), numbers, operation, distribution, where)


def _patterns(names: Any) -> tuple[str, ...] | None:
    if isinstance(names, str):
        return (names,)
    return tuple(str(one) for one in names) if isinstance(names, list | tuple) else None


def _pair(value: Any) -> tuple[float, float] | None:
    if not isinstance(value, list | tuple) or len(value) != 2:
        return None
    if any(isinstance(one, bool) or not isinstance(one, int | float) for one in value):
        return None
    first, second = float(value[0]), float(value[1])
    return (first, second) if first - first == 0.0 == second - second else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
