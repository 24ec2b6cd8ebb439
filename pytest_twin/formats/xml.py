"""Parse XML safely: no DTD, entities, includes or network access, and limits on size and depth."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeAlias
from xml.parsers import expat

from lxml import etree

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.declared_inputs import expansion_of
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.paths import read_bytes

Element: TypeAlias = etree._Element

_XINCLUDE = "{http://www.w3.org/2001/XInclude}"
_DECLARED_ENCODING = re.compile(
    rb"<\?xml[^>]{0,200}?encoding\s*=\s*[\"']([A-Za-z0-9._-]{1,40})[\"']"
)
# 8-bit encodings in which '<' is always '<'.
_ENCODINGS = {"utf-8", "ascii", "iso8859-1", "iso8859-15", "cp1252"}
_TOLERATED = {
    "NS_ERR_UNDEFINED_NAMESPACE": "a prefix that no xmlns declares",
    "ERR_HYPHEN_IN_COMMENT": "two hyphens in a comment",
}
"""Error code of the parser that leaves the elements unambiguous -> description."""
# Sections in which a comment's delimiters have no meaning, and comments.
_SECTIONS = re.compile(rb"<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<!--.*?-->", re.DOTALL)
# Plain decimal text: float() alone would also take '1_0', 'infinity' and other scripts' digits.


@dataclass(frozen=True, slots=True)
class Irregularity:
    """A violation of the XML standard that leaves the elements unambiguous."""

    line: int
    words: str


def parse(path: Path) -> Element:
    """Return the root element of an XML file, without comments; ``.sourceline`` has the line.

    Loaders of robot files (tinyxml2) accept undeclared prefixes and ``--`` in comments. This
    function accepts them too, and :func:`irregularities` lists them. An undeclared prefix remains
    part of the name. A xacro file that the command expanded is read as its URDF.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.XML``.
        FormatError: not well-formed, an unsupported encoding, or a DTD or XInclude.
    """
    return parse_bytes(_read(path), path)


def irregularities(path: Path) -> tuple[Irregularity, ...]:
    """Return the violations of the XML standard in a file that :func:`parse` accepts, by line.

    Raises:
        PathError, LimitError, FormatError: as :func:`parse`.
    """
    return _parse(_read(path), path)[1]


def _read(path: Path) -> bytes:
    expansion = expansion_of(path)
    return read_bytes(path if expansion is None else expansion.urdf, limits.XML.file_bytes)


def parse_bytes(data: bytes, path: Path) -> Element:
    """Return the root element of XML text; ``path`` is used in errors only.

    Raises:
        LimitError: beyond ``limits.XML``.
        FormatError: as :func:`parse`.
    """
    return _parse(data, path)[0]


def content_sha256(path: Path) -> str:
    """Return the SHA-256 of an XML file's elements and attributes, hex.

    Comments, white space, the order of attributes and the style of quotes do not change it.

    Raises:
        PathError, LimitError, FormatError: as :func:`parse`.
    """
    # Canonical XML 2.0; the type stubs of lxml know only version 1.
    text = etree.tostring(parse(path), method="c14n2", with_comments=False, strip_text=True)  # type: ignore[call-overload]
    return bytes_sha256(bytes(text))


def plain_name(name: str, element: Element) -> str:
    """Return a tag or attribute name as written in the file: ``prefix:name``, without namespace."""
    if not name.startswith("{"):
        return name
    space, _, local = name[1:].partition("}")
    prefix = next((key for key, uri in element.nsmap.items() if uri == space and key), None)
    return f"{prefix}:{local}" if prefix else local


def _parse(data: bytes, path: Path) -> tuple[Element, tuple[Irregularity, ...]]:
    require_at_most(len(data), limits.XML.file_bytes, "file is too large", unit="bytes", path=path)
    # Convert to one encoding, so that the checks below see the same text as the parser.
    data = _as_utf8(data, path)
    if not data.strip():
        raise FormatError("empty file", path=path, line=1, expected="an XML element")
    if b"<!DOCTYPE" in data:
        _refuse_doctype(data, path)
    # Each element has at least one '<' and each attribute one '=': check before allocating memory.
    if data.count(b"<") > 2 * limits.XML.elements_count:
        _too_many("elements", limits.XML.elements_count, path)
    if data.count(b"=") > 2 * limits.XML.attributes_count:
        _too_many("attributes", limits.XML.attributes_count, path)
    found: tuple[Irregularity, ...] = ()
    parser = _parser()
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        line, column = error.position
        if "Excessive depth" in str(error.msg):  # the parser's own depth limit, equal to limits.XML
            _too_deep(line or None, path)
        tolerated = _parse_tolerantly(data, parser.error_log)
        if tolerated is None:
            raise FormatError(
                f"not well-formed XML: {str(error.msg).rsplit(', line', 1)[0]}",
                path=path,
                line=line or None,
                column=column or None,
            ) from None
        root, found = tolerated
    _bound(root, path)
    return root, found


def _parser(*, recover: bool = False) -> etree.XMLParser:
    return etree.XMLParser(
        encoding="utf-8",
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
        recover=recover,
    )


def _parse_tolerantly(data: bytes, refusal: Any) -> tuple[Element, tuple[Irregularity, ...]] | None:
    """Return the root if :data:`_TOLERATED` covers all errors, else None."""
    parser = _parser(recover=True)
    try:
        root = etree.fromstring(_blank_comments(data), parser)
    except etree.XMLSyntaxError:
        return None
    left = [entry for entry in parser.error_log if entry.type_name not in _TOLERATED]
    if root is None or left:
        return None
    words = {(entry.line, _TOLERATED.get(entry.type_name, "")) for entry in refusal}
    words |= {(entry.line, _TOLERATED[entry.type_name]) for entry in parser.error_log}
    return root, tuple(Irregularity(line, said) for line, said in sorted(words) if said)


def _blank_comments(data: bytes) -> bytes:
    """Return the text with empty comments and unchanged line numbers."""

    def blank(match: re.Match[bytes]) -> bytes:
        part = match[0]
        if not part.startswith(b"<!--"):
            return part
        return b"<!--" + b"\n" * part.count(b"\n") + b"-->"

    return _SECTIONS.sub(blank, data)


def _line(element: Element) -> int | None:
    line: Any = element.sourceline
    return None if line is None else int(line)


def _as_utf8(data: bytes, path: Path) -> bytes:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        declared = _DECLARED_ENCODING.match(data.removeprefix(codecs.BOM_UTF8))
        name = "utf-8" if declared is None else declared[1].decode("ascii")
        try:
            encoding = codecs.lookup(name).name
        except LookupError:
            encoding = name
        if encoding not in _ENCODINGS:
            raise FormatError("unusual encoding", path=path, line=1, value=name, expected="UTF-8")
        if encoding == "utf-8":
            encoding = "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        before = data[: error.start]
        raise FormatError(
            f"not {encoding.removesuffix('-sig')} text",
            path=path,
            line=before.count(b"\n") + 1,
            column=error.start - (before.rfind(b"\n") + 1) + 1,
            expected="UTF-8",
        ) from None
    odd = text.find("\0")
    if odd >= 0:
        raise FormatError(
            "a NUL character", path=path, line=text.count("\n", 0, odd) + 1, expected="text"
        )
    try:
        return text.encode("utf-8")
    except UnicodeEncodeError:
        raise FormatError("a lone surrogate", path=path, expected="text") from None


def _refuse_doctype(data: bytes, path: Path) -> None:
    """Refuse a document type, but not the same text in a comment, before libxml2 parses it."""
    scanner = expat.ParserCreate("utf-8")

    def refuse(*_: object) -> NoReturn:
        raise FormatError(
            "a document type (DTD)",
            path=path,
            line=scanner.CurrentLineNumber,
            column=scanner.CurrentColumnNumber + 1,
            expected="plain elements, no <!DOCTYPE",
        )

    scanner.StartDoctypeDeclHandler = refuse
    try:
        scanner.Parse(data, True)
    except expat.ExpatError as error:
        raise FormatError(
            f"not well-formed XML: {expat.ErrorString(error.code)}",
            path=path,
            line=error.lineno,
            column=error.offset + 1,
        ) from None


def _bound(root: Element, path: Path) -> None:
    elements = attributes = depth = 0
    for event, element in etree.iterwalk(root, events=("start", "end")):
        if event == "end":
            depth -= 1
            continue
        depth += 1
        elements += 1
        attributes += len(element.attrib)
        if depth > limits.XML.depth_levels:
            _too_deep(_line(element), path)
        if isinstance(element.tag, str) and element.tag.startswith(_XINCLUDE):
            raise FormatError(
                "an XInclude", path=path, line=_line(element), expected="the elements themselves"
            )
    if elements > limits.XML.elements_count:
        _too_many("elements", limits.XML.elements_count, path)
    if attributes > limits.XML.attributes_count:
        _too_many("attributes", limits.XML.attributes_count, path)


def _too_deep(line: int | None, path: Path) -> NoReturn:
    raise LimitError(
        "nested too deep",
        path=path,
        line=line,
        expected=f"at most {limits.XML.depth_levels} levels",
    )


def _too_many(what: str, bound: int, path: Path) -> NoReturn:
    raise LimitError(f"too many {what}", path=path, expected=f"at most {bound}")


def digits(values: Iterable[float]) -> str:
    """Return numbers as an attribute: the shortest decimal text that gives the same numbers.

    A zero has no sign.
    """
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)
