"""Compile a JSON Schema into a plain function that returns True or False."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

Fits: TypeAlias = Callable[[Any], bool]


class _UnknownKeywordError(Exception):
    """The schema uses a keyword that the compiler does not support."""


def compile_schema(schema: Mapping[str, Any]) -> Fits | None:
    """Return a function that tests data against ``schema`` (Draft 2020-12).

    Returns:
        the function, or None if the schema uses an unsupported keyword; ``jsonschema`` then has to
        do the validation.
    """
    try:
        return _Compiler(schema).compile(schema)
    except _UnknownKeywordError:
        return None


_ANNOTATIONS = frozenset(
    {
        "$schema", "$id", "$comment", "$defs", "title", "description", "default", "examples",
        "deprecated", "readOnly", "writeOnly", "format", "then", "else", "contentMediaType",
        "markdownDescription", "defaultSnippets",
    }
)  # fmt: skip

# JSON Schema: 1.0 is an integer, True is not a number.
_TYPES: dict[str, Fits] = {
    "object": lambda v: isinstance(v, dict),
    "array": lambda v: isinstance(v, list),
    "string": lambda v: isinstance(v, str),
    "null": lambda v: v is None,
    "boolean": lambda v: isinstance(v, bool),
    "number": lambda v: isinstance(v, int | float) and not isinstance(v, bool),
    "integer": lambda v: (
        (isinstance(v, int) and not isinstance(v, bool))
        or (isinstance(v, float) and v.is_integer())
    ),
}


class _Compiler:
    def __init__(self, root: Mapping[str, Any]) -> None:
        self.root = root
        self.references: dict[str, list[Fits]] = {}

    def compile(self, schema: Any) -> Fits:
        if schema is True or schema == {}:
            return lambda _: True
        if schema is False:
            return lambda _: False
        if not isinstance(schema, Mapping):
            raise _UnknownKeywordError
        tests: list[Fits] = []
        for keyword, value in schema.items():
            if keyword in _ANNOTATIONS:
                continue
            if keyword in _OBJECT_KEYWORDS:
                continue
            make = getattr(self, f"make_{keyword.replace('$', '')}", None)
            if make is None:
                raise _UnknownKeywordError
            tests.append(make(value, schema))
        if not _OBJECT_KEYWORDS.isdisjoint(schema):
            tests.append(self.make_object(schema))
        return _all(tests)

    def make_type(self, value: Any, _: Any) -> Fits:
        names = [value] if isinstance(value, str) else list(value)
        if any(name not in _TYPES for name in names):
            raise _UnknownKeywordError
        return _any([_TYPES[name] for name in names])

    def make_enum(self, value: list[Any], _: Any) -> Fits:
        if not all(isinstance(item, str) for item in value):
            return lambda v: any(_are_equal(v, item) for item in value)
        words = frozenset(value)
        return lambda v: isinstance(v, str) and v in words

    def make_const(self, value: Any, _: Any) -> Fits:
        return lambda v: _are_equal(v, value)

    def make_ref(self, value: str, _: Any) -> Fits:
        if value != "#" and not value.startswith("#/"):
            raise _UnknownKeywordError
        if value not in self.references:
            holder = self.references[value] = []
            target: Any = self.root
            for part in value[2:].split("/") if value != "#" else []:
                part = part.replace("~1", "/").replace("~0", "~")
                if not isinstance(target, Mapping) or part not in target or "%" in part:
                    raise _UnknownKeywordError
                target = target[part]
                if isinstance(target, Mapping) and "$id" in target:
                    raise _UnknownKeywordError
            holder.append(self.compile(target))
        holder = self.references[value]
        # Look the target up when data is tested: a schema may refer to itself.
        return lambda v: holder[0](v)

    # The names of these methods are ``make_`` and the keyword of JSON Schema (hence noqa N802).
    def make_allOf(self, value: list[Any], _: Any) -> Fits:  # noqa: N802
        return _all([self.compile(item) for item in value])

    def make_anyOf(self, value: list[Any], _: Any) -> Fits:  # noqa: N802
        return _any([self.compile(item) for item in value])

    def make_oneOf(self, value: list[Any], _: Any) -> Fits:  # noqa: N802
        tests = [self.compile(item) for item in value]
        return lambda v: sum(test(v) for test in tests) == 1

    def make_not(self, value: Any, _: Any) -> Fits:
        test = self.compile(value)
        return lambda v: not test(v)

    def make_if(self, value: Any, schema: Mapping[str, Any]) -> Fits:
        test = self.compile(value)
        then = self.compile(schema.get("then", True))
        otherwise = self.compile(schema.get("else", True))
        return lambda v: then(v) if test(v) else otherwise(v)

    def make_pattern(self, value: str, _: Any) -> Fits:
        search = re.compile(value).search
        return lambda v: not isinstance(v, str) or search(v) is not None

    def make_minLength(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, str) or len(v) >= value

    def make_maxLength(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, str) or len(v) <= value

    def make_minimum(self, value: float, _: Any) -> Fits:
        number = _TYPES["number"]
        return lambda v: not number(v) or v >= value

    def make_maximum(self, value: float, _: Any) -> Fits:
        number = _TYPES["number"]
        return lambda v: not number(v) or v <= value

    def make_exclusiveMinimum(self, value: float, _: Any) -> Fits:  # noqa: N802
        number = _TYPES["number"]
        return lambda v: not number(v) or v > value

    def make_exclusiveMaximum(self, value: float, _: Any) -> Fits:  # noqa: N802
        number = _TYPES["number"]
        return lambda v: not number(v) or v < value

    def make_items(self, value: Any, schema: Mapping[str, Any]) -> Fits:
        test = self.compile(value)
        first = len(schema.get("prefixItems", ()))
        return lambda v: not isinstance(v, list) or all(map(test, v[first:] if first else v))

    def make_prefixItems(self, value: list[Any], _: Any) -> Fits:  # noqa: N802
        tests = [self.compile(item) for item in value]
        return lambda v: (
            not isinstance(v, list) or all(test(item) for test, item in zip(tests, v, strict=False))
        )

    def make_minItems(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, list) or len(v) >= value

    def make_maxItems(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, list) or len(v) <= value

    def make_uniqueItems(self, value: bool, _: Any) -> Fits:  # noqa: N802
        if not value:
            return lambda _: True
        return lambda v: (
            not isinstance(v, list)
            or (len(set(v)) == len(v) if all(isinstance(i, str) for i in v) else _are_unique(v))
        )

    def make_minProperties(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, dict) or len(v) >= value

    def make_maxProperties(self, value: int, _: Any) -> Fits:  # noqa: N802
        return lambda v: not isinstance(v, dict) or len(v) <= value

    def make_propertyNames(self, value: Any, _: Any) -> Fits:  # noqa: N802
        test = self.compile(value)
        return lambda v: not isinstance(v, dict) or all(map(test, v))

    def make_dependentRequired(self, value: Mapping[str, list[str]], _: Any) -> Fits:  # noqa: N802
        return lambda v: (
            not isinstance(v, dict)
            or all(name in v for key, names in value.items() if key in v for name in names)
        )

    def make_object(self, schema: Mapping[str, Any]) -> Fits:
        """Compile all keywords about fields into one function that visits each field once."""
        required = tuple(schema.get("required", ()))
        fields = {name: self.compile(part) for name, part in schema.get("properties", {}).items()}
        patterns = [
            (re.compile(pattern).search, self.compile(part))
            for pattern, part in schema.get("patternProperties", {}).items()
        ]
        rest = schema.get("additionalProperties", True)
        other = None if rest is True else self.compile(rest)

        def fits(data: Any) -> bool:
            if not isinstance(data, dict):
                return True
            for name in required:
                if name not in data:
                    return False
            for name, value in data.items():
                test = fields.get(name)
                if test is not None and not test(value):
                    return False
                known = test is not None
                for search, check in patterns:
                    if search(name):
                        known = True
                        if not check(value):
                            return False
                if other is not None and not known and not other(value):
                    return False
            return True

        return fits


_OBJECT_KEYWORDS = frozenset(
    {"required", "properties", "patternProperties", "additionalProperties"}
)


def _all(tests: list[Fits]) -> Fits:
    if len(tests) == 1:
        return tests[0]
    if len(tests) == 2:
        first, second = tests
        return lambda v: first(v) and second(v)

    def fits(data: Any) -> bool:
        for test in tests:  # noqa: SIM110 - half the time of all() on a generator
            if not test(data):
                return False
        return True

    return fits


def _any(tests: list[Fits]) -> Fits:
    if len(tests) == 1:
        return tests[0]

    def fits(data: Any) -> bool:
        for test in tests:  # noqa: SIM110 - as above
            if test(data):
                return True
        return False

    return fits


def _are_equal(left: Any, right: Any) -> bool:
    """Whether two JSON values are equal: 1 equals 1.0, and 1 does not equal True."""
    if isinstance(left, bool) or isinstance(right, bool):
        return left is right
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(_are_equal, left, right))
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(_are_equal(left[k], right[k]) for k in left)
    return bool(left == right)


def _are_unique(items: list[Any]) -> bool:
    return not any(_are_equal(a, b) for i, a in enumerate(items) for b in items[:i])
