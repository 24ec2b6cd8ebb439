"""Build typed values from parsed JSON or YAML, and the reverse, by msgspec."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any, TypeVar

Value = TypeVar("Value")
_STEP = re.compile(r"\.(\w+)|\[(\d+|\.\.\.)\]")
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table of fields",
    "null": "nothing",
}


class FieldError(ValueError):
    """A field that is missing, or has a value of another type than it should.

    Attributes:
        where: the field, dotted.
        value: its value; None for a missing field, a list or a table.
        expected: description of a valid value.
    """

    def __init__(self, where: str, value: object, expected: str) -> None:
        super().__init__(f"{where}: expected {expected}")
        self.where, self.expected = where, expected
        self.value = value if isinstance(value, str | int | float) else None


def build(data: object, kind: type[Value]) -> Value:
    """Return ``data`` as a ``kind``: a dataclass, or a mapping or tuple of typed values.

    Fields of a dataclass that ``data`` lacks have their defaults; others are ignored.

    Raises:
        FieldError: a value is missing or of another type.
    """
    import msgspec

    try:
        return msgspec.convert(data, kind, dec_hook=_of_text)
    except msgspec.ValidationError as error:
        raise _field_error(str(error), data, kind) from None


def plain(value: object) -> Any:
    """Return a typed value as dicts, lists, text and numbers."""
    import msgspec

    return msgspec.to_builtins(value, enc_hook=str)


def _field_error(message: str, data: object, kind: type[Any]) -> FieldError:
    """Return an error of msgspec with the refused value and the full path of its field."""
    import msgspec

    problem, _, place = message.partition(" - at `$")
    parts: list[str] = []
    root: dict[Any, Any] = {"": copy.deepcopy(data)}
    owner: Any = root
    key: Any = ""
    for step in _STEP.finditer(place):
        here: Any = owner[key]
        name: Any = step[1]
        if step[2] == "...":
            # msgspec leaves out the keys of mappings: find the one whose value alone is refused.
            for name, value in here.items():
                owner[key] = {name: value}
                try:
                    msgspec.convert(root[""], kind, dec_hook=_of_text)
                except msgspec.ValidationError:
                    break
        elif step[2]:
            name = int(step[2])
        owner, key = owner[key], name
        parts.append(str(name))
    if field := re.fullmatch(r"Object (missing required|contains unknown) field `(.+)`", problem):
        expected = "this field" if field[1].startswith("missing") else "no field of this name"
        return FieldError(".".join([*parts, field[2]]), None, expected)
    expected = re.sub(r", got `\w+`$", "", problem).removeprefix("Expected ")
    expected = re.sub(r"`([\w| ]+)`", _in_words, expected)
    if problem.startswith("Invalid enum value"):
        expected = "one of the values that this field can have"
    return FieldError(".".join(parts), owner[key], expected)


def _in_words(names: re.Match[str]) -> str:
    return " or ".join(_WORDS.get(name, name) for name in names[1].split(" | "))


def _of_text(kind: type, value: Any) -> Any:
    if kind is not Path or not isinstance(value, str | Path):
        raise ValueError(f"Expected `{kind.__name__}`, got {value!r}")
    return Path(value)
