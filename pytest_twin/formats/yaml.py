"""Read and write strict YAML, an unambiguous subset of YAML 1.2, with the line of each field.

Plain scalars follow the YAML 1.2 core schema: ``1e-6`` is a number, ``no``, ``on`` and ``12:30``
are strings. Anchors, aliases, tags, merge keys, repeated keys and numbers that are not finite are
refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import yaml

from pytest_twin.errors import FormatError, LimitError, SpecError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes

try:
    from yaml._yaml import CParser as _Parser
except ImportError:
    # PyYAML without libyaml gives the same events, only slower.
    from yaml import Loader as _Parser  # type: ignore[assignment]

RECORDED_MARK = "# --- recorded by pytest --twin-update; a person reads this as a diff ---"
"""Line of a golden spec below which pytest --twin-update writes everything."""

RECORDED_KEYS = ("expected", "trace", "provenance")
"""Top-level keys of a golden spec that pytest --twin-update writes, in this order."""

_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_WORDS: dict[str, bool | None] = {
    "": None,
    "~": None,
    "null": None,
    "Null": None,
    "NULL": None,
    "true": True,
    "True": True,
    "TRUE": True,
    "false": False,
    "False": False,
    "FALSE": False,
}
_FIRST_OF_NUMBER = frozenset("+-.0123456789")
# Control characters, and the line ends that editors and parsers count differently.
_UNPRINTABLE = re.compile(
    r"[^\t\n\r\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]"
    r"|\r(?!\n)"
)
# Message of libyaml at its own depth limit, which its lookahead may reach before limits.YAML.
_TOO_DEEP = "exceeded maximum nesting depth"
_LINE_WIDTH = 80
"""Number of characters after which a written line ends at the next item or word."""
# Words that some YAML readers interpret as a truth value, a null or a number.
_SPECIAL = re.compile(
    r"(?:y|n|yes|no|on|off|true|false|null|nan|inf|\.nan|\.inf|[-+.0-9].*)", re.IGNORECASE
)


@dataclass(frozen=True)
class Document:
    """Content of a YAML file and the line of each field.

    Attributes:
        data: dict, list, str, int, float, bool and None; dict keys are str.
        lines: dotted field -> 1-based line (``tolerance.position``, ``parts.0.id``); ``""`` is
            the document itself.
    """

    data: Any
    lines: dict[str, int] = field(default_factory=dict)
    path: Path = Path("<text>")


def load(path: Path) -> Document:
    """Read a YAML file.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.YAML``.
        FormatError: not UTF-8, or not strict YAML; with line and column.
    """
    return loads(read_text(path), path)


def read_text(path: Path) -> str:
    """Return the text of a YAML file with unchanged line ends, limited as :func:`load`."""
    return decode_text(read_bytes(path, limits.YAML.file_bytes), path)


def loads(text: str, path: Path) -> Document:
    """Parse YAML text; ``path`` is used in errors only.

    Raises:
        LimitError: beyond ``limits.YAML``.
        FormatError: not strict YAML; with line and column.
    """
    require_at_most(len(text), limits.YAML.file_bytes, "file is too large", unit="bytes", path=path)
    odd = _UNPRINTABLE.search(text)
    if odd is not None:
        line = text.count("\n", 0, odd.start()) + 1
        column = odd.start() - text.rfind("\n", 0, odd.start())
        raise FormatError(
            "a character that YAML text may not contain",
            path=path,
            line=line,
            column=column,
            value=f"U+{ord(odd[0]):04X}",
            expected="printable characters, tabs and line feeds; remove this one",
        )
    reader = _Reader(text, path)
    try:
        return reader.document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        words = " ".join(part for part in (error.context, error.problem) if part)
        if _TOO_DEEP in words:
            raise _too_deep(path, mark) from None
        raise FormatError(
            f"not YAML: {words}",
            path=path,
            line=None if mark is None else mark.line + 1,
            column=None if mark is None else mark.column + 1,
        ) from None
    except yaml.YAMLError as error:
        raise FormatError(f"not YAML: {error}", path=path) from None
    except RecursionError:
        raise _too_deep(path, None) from None
    finally:
        reader.parser.dispose()


def _too_deep(path: Path, mark: Any) -> LimitError:
    return LimitError(
        "nested too deep",
        path=path,
        line=None if mark is None else mark.line + 1,
        column=None if mark is None else mark.column + 1,
        expected=f"at most {limits.YAML.depth_levels} levels",
    )


class _Reader:
    """Builds plain data from parser events, checking every limit before it allocates memory."""

    def __init__(self, text: str, path: Path) -> None:
        self.path = path
        self.lines: dict[str, int] = {}
        self.nodes = 0
        self.parser: Any = _Parser(text)
        self.next = self.parser.get_event

    def document(self) -> Document:
        self.next()  # stream start
        event: Any = self.next()
        if not isinstance(event, yaml.DocumentStartEvent):
            raise FormatError("empty file", path=self.path, line=1, expected="a YAML mapping")
        if event.tags:
            self.refuse(event, "a %TAG directive")
        data = self.value(self.next(), "", 0)
        self.next()  # document end
        event = self.next()
        if not isinstance(event, yaml.StreamEndEvent):
            self.refuse(event, "a second document", "one document")
        return Document(data, self.lines, self.path)

    def refuse(self, event: Any, problem: str, expected: str | None = None) -> NoReturn:
        mark = event.start_mark
        raise FormatError(
            problem, path=self.path, line=mark.line + 1, column=mark.column + 1, expected=expected
        )

    def value(self, event: Any, at: str, depth: int) -> Any:
        kind = type(event)
        self.nodes += 1
        if self.nodes > limits.YAML.nodes_count:
            raise LimitError(
                "too many values", path=self.path, expected=f"at most {limits.YAML.nodes_count}"
            )
        if kind is yaml.AliasEvent:
            self.refuse(event, "an alias (*name)", "the value written out")
        if event.anchor is not None:
            self.refuse(event, "an anchor (&name)", "the value written out at each place")
        if event.tag is not None:
            self.refuse(event, f"a tag ({event.tag[:40]})", "a plain value")
        if kind is yaml.ScalarEvent:
            if at not in self.lines:
                self.lines[at] = event.start_mark.line + 1
            text: str = event.value
            return text if event.style else self.plain(event, text)
        if depth >= limits.YAML.depth_levels:
            raise _too_deep(self.path, event.start_mark)
        if at not in self.lines:
            self.lines[at] = event.start_mark.line + 1
        prefix = at + "." if at else ""
        if kind is yaml.MappingStartEvent:
            return self.mapping(prefix, depth)
        items: list[Any] = []
        event = self.next()
        while type(event) is not yaml.SequenceEndEvent:
            items.append(self.value(event, f"{prefix}{len(items)}", depth + 1))
            event = self.next()
        return items

    def mapping(self, prefix: str, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        event: Any = self.next()
        while type(event) is not yaml.MappingEndEvent:
            key = self.key(event)
            at = prefix + key
            if key in found:
                first = self.lines.get(at)
                self.refuse(event, f"key {key[:80]!r} occurs a second time (first: {first})")
            # The line of a field is that of its key, even if its value starts later.
            self.lines[at] = event.start_mark.line + 1
            found[key] = self.value(self.next(), at, depth + 1)
            event = self.next()
        return found

    def key(self, event: Any) -> str:
        if type(event) is not yaml.ScalarEvent:
            if type(event) is yaml.AliasEvent:
                self.refuse(event, "an alias (*name)", "the value written out")
            self.refuse(event, "a key that is not text", "a name before the colon")
        if event.anchor is not None:
            self.refuse(event, "an anchor (&name)", "the value written out at each place")
        if event.tag is not None:
            self.refuse(event, f"a tag ({event.tag[:40]})", "a plain value")
        key: str = event.value
        if not event.style and key == "<<":
            self.refuse(event, "a merge key (<<)", "the fields written out")
        if not key:
            self.refuse(event, "an empty key", "a name before the colon")
        if len(key) > limits.YAML.key_chars:
            self.refuse(
                event, "a key that is too long", f"at most {limits.YAML.key_chars} characters"
            )
        return key

    def plain(self, event: Any, text: str) -> Any:
        if text in _WORDS:
            return _WORDS[text]
        if text[0] not in _FIRST_OF_NUMBER:
            return text
        if _INT.fullmatch(text):
            # Python limits the digits of int(); other readers are limited to 64 bits.
            number = int(text, 0 if text[:2] in ("0o", "0x") else 10) if len(text) <= 32 else None
            if number is None or not -(2**63) <= number < 2**63:
                self.refuse(event, "an integer that is out of range", "at most 64 bits")
            return number
        if _FLOAT.fullmatch(text):
            value = float(text)
            if not math.isfinite(value):
                self.refuse(event, f"number {text[:40]} is out of range", "a finite number")
            return value
        if _NOT_FINITE.fullmatch(text):
            self.refuse(event, f"{text} is not a finite number", "a finite number")
        return text


def recorded_block(recorded: dict[str, Any]) -> str:
    """Return the recorded part of a golden spec, mark included; equal data give equal text.

    Floats are written so that they read back as the same number.

    Raises:
        SpecError: a key that is not in ``RECORDED_KEYS``, or a number that is not finite.
    """
    unknown = [key for key in recorded if key not in RECORDED_KEYS]
    if unknown:
        raise SpecError("not a recorded key", where=unknown[0], expected=", ".join(RECORDED_KEYS))
    ordered = {key: recorded[key] for key in RECORDED_KEYS if key in recorded}
    return f"{RECORDED_MARK}\n{dump(ordered)}"


def rewrite_recorded(text: str, recorded: dict[str, Any], path: Path = Path("<text>")) -> str:
    """Return a golden spec with its recorded part replaced.

    Everything above ``RECORDED_MARK`` is kept unchanged (a missing last line end is added). The
    mark and all below it are rewritten. An empty ``recorded`` removes the mark and the part below.

    Raises:
        SpecError: a recorded key is above the mark or another key below it, with its line; the
            spec is not a block mapping; or YAML cannot represent ``recorded``.
        FormatError: ``text`` is not strict YAML.
    """
    document = loads(text, path)
    if not isinstance(document.data, dict):
        raise SpecError(
            "not a mapping of fields",
            path=path,
            line=1,
            expected="fields of a golden spec, such as 'kind: fk'",
        )
    pieces = text.split("\n")
    at = next((i for i, piece in enumerate(pieces) if piece.rstrip() == RECORDED_MARK), None)
    for key in document.data:
        line = document.lines[key]
        below = at is not None and line > at + 1
        if key in RECORDED_KEYS and not below:
            raise SpecError(
                "is written by pytest --twin-update, but is above the recorded mark",
                path=path,
                line=line,
                where=key,
                expected=f"to be below the line {RECORDED_MARK!r}, or deleted",
            )
        if key not in RECORDED_KEYS and below:
            raise SpecError(
                "is below the recorded mark, where pytest --twin-update writes",
                path=path,
                line=line,
                where=key,
                expected="to be above it",
            )
    human = text if at is None else "".join(piece + "\n" for piece in pieces[:at])
    end = "\r\n" if human.split("\n", 1)[0].endswith("\r") else "\n"
    if human and not human.endswith("\n"):
        human += end
    if not recorded:
        return human
    result = human + recorded_block(recorded).replace("\n", end)
    kept = {key: value for key, value in document.data.items() if key not in RECORDED_KEYS}
    try:
        readable = loads(result, path).data == {**kept, **recorded}
    except FormatError:
        readable = False
    if not readable:
        raise SpecError(
            "fields cannot be appended to this file",
            path=path,
            line=1,
            expected="one field per line (block style), no '...' at the end",
        )
    return result


def dump(content: object) -> str:
    """Return content as YAML that :func:`loads` reads back unchanged.

    A list without tables is on one line if it is short, or if it has plain values alone.

    Raises:
        SpecError: a value that is not plain data, or a number that is not finite; with its field.
    """
    _require_plain(content, "")
    text: str = yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, width=_LINE_WIDTH, allow_unicode=True
    )
    return text


class _Dumper(yaml.SafeDumper):
    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, indentless=False)

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        items = list(sequence)
        nested = any(isinstance(item, dict | list | tuple) for item in items)
        on_one_line = not nested or ("{" not in str(items) and len(str(items)) < _LINE_WIDTH)
        return super().represent_sequence(tag, items, flow_style=on_one_line)

    def represent_text(self, text: str) -> yaml.ScalarNode:
        # YAML 1.1, which PyYAML writes, reads fewer texts as numbers than YAML 1.2.
        quoted = not text.isprintable() or _SPECIAL.fullmatch(text)
        return self.represent_scalar("tag:yaml.org,2002:str", text, style='"' if quoted else None)


_Dumper.add_representer(str, _Dumper.represent_text)
_Dumper.add_multi_representer(float, lambda dumper, value: dumper.represent_float(float(value)))


def _require_plain(value: object, where: str) -> None:
    """Check that YAML can represent a value.

    Raises:
        SpecError: it cannot; with the field.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str) or not key:
                raise SpecError("a key that is not text", where=where, value=key, expected="a name")
            _require_plain(inner, f"{where}.{key}" if where else key)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            _require_plain(inner, f"{where}.{index}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise SpecError("not a finite number", where=where, value=value, expected="a finite number")
    elif not isinstance(value, str | int | float | None):
        raise SpecError(
            f"a {type(value).__name__} cannot be written as YAML",
            where=where,
            expected="text, a number, true, false, null, a list or a mapping",
        )
