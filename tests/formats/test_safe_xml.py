"""Safe XML parsing: no document types, no includes, size limits, errors with line."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import xml

PATH = Path("robot.urdf")


def parse(text: str) -> xml.Element:
    return xml.parse_bytes(text.encode(), PATH)


def test_elements_have_line_numbers_and_comments_are_dropped() -> None:
    root = parse("<?xml version='1.0'?>\n<robot>\n<!-- <!DOCTYPE x> -->\n<link/>\n</robot>")
    assert [(child.tag, child.sourceline) for child in root] == [("link", 4)]


ENTITY_EXPANSION = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>\n<r x="&b;">&b;</r>'


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (ENTITY_EXPANSION, 1, "a document type (DTD)"),
        ('<!DOCTYPE r SYSTEM "http://127.0.0.1/x.dtd"><r/>', 1, "a document type (DTD)"),
        ('\n<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><r>&x;</r>', 2, "(DTD)"),
        ("<r>\n&x;</r>", 2, "not well-formed XML"),
        ("<r>\n<a></r>", 2, "not well-formed XML"),
        ("<r a='1' a='2'/>", 1, "not well-formed XML"),
        ("<r/><r/>", 1, "not well-formed XML"),
        ("text", 1, "not well-formed XML"),
        ("", 1, "empty file"),
        (" \n ", 1, "empty file"),
        ("<r>\n\0</r>", 2, "a NUL character"),
        (
            '<r xmlns:i="http://www.w3.org/2001/XInclude">\n<i:include href="/etc/passwd"/></r>',
            2,
            "an XInclude",
        ),
        ('<?xml version="1.0" encoding="utf-7"?><r/>', 1, "unusual encoding"),
        ('<?xml version="1.0" encoding="rot13"?><r/>', 1, "unusual encoding"),
        ('<?xml version="1.0" encoding="nonsense"?><r/>', 1, "unusual encoding"),
    ],
)
def test_invalid_or_unsafe_xml_is_refused_with_its_line(text: str, line: int, words: str) -> None:
    with pytest.raises(FormatError) as caught:
        parse(text)
    assert words in str(caught.value)
    assert caught.value.line == line
    assert caught.value.path == PATH


@pytest.mark.parametrize("encoding", ["utf-8", "iso-8859-1", "cp1252", "utf-16"])
def test_common_text_encodings_are_read(encoding: str) -> None:
    text = f'<?xml version="1.0" encoding="{encoding}"?><r name="é"/>'
    assert xml.parse_bytes(text.encode(encoding), PATH).get("name") == "é"


@pytest.mark.parametrize("encoding", ["utf-16", "iso-8859-1"])
def test_a_document_type_is_refused_in_every_encoding(encoding: str) -> None:
    text = f'<?xml version="1.0" encoding="{encoding}"?>{ENTITY_EXPANSION}'
    with pytest.raises(FormatError, match="a document type"):
        xml.parse_bytes(text.encode(encoding), PATH)


def test_invalid_text_bytes_are_reported_with_line_and_column() -> None:
    with pytest.raises(FormatError, match="not utf-8 text") as caught:
        xml.parse_bytes(b"<r>\n <a b='\xff'/></r>", PATH)
    assert (caught.value.line, caught.value.column) == (2, 8)


def test_nesting_depth_of_xml_is_limited() -> None:
    assert parse("<a>" * 200 + "</a>" * 200) is not None
    for depth in (257, 100_000):
        with pytest.raises(LimitError, match=r"nested too deep \(expected at most 256 levels\)"):
            parse("<a>" * depth + "</a>" * depth)


def test_the_number_of_xml_elements_is_limited() -> None:
    with pytest.raises(LimitError, match="too many elements"):
        parse("<r>" + "<a/>" * 1_100_000 + "</r>")


def test_a_too_large_xml_file_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    with path.open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(LimitError, match="file is too large"):
        xml.parse(path)
