"""Find out how a CSV file is written: compression, separator, decimal mark, quotes, headings."""

from __future__ import annotations

import csv
import io
import re
import zlib
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.errors import FormatError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes

GZIP_SUFFIX = ".csv.gz"
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_BLOCK_BYTES = 2**20
# Lines before the headings, such as comments.
_LINES_BEFORE = 100
_EXCEL_SEPARATOR = re.compile(r"sep=(.)", re.IGNORECASE)
_TEXT = re.compile(rb"\S")
_NUMBER = re.compile(rb'\s*"?[-+]?[\d.]')
_COMMA_NUMBER = re.compile(rb"(?<![\d,.])[-+]?\d+,\d+(?:[eE][-+]?\d+)?(?![\d,.])")
_POINT_NUMBER = re.compile(rb"(?<![\d,.])[-+]?\d+\.\d+(?:[eE][-+]?\d+)?(?![\d,.])")
# 1,234 may be 1.234 or 1234; 0,234 and 1,23 are decimals.
_THOUSANDS = re.compile(rb"[-+]?[1-9]\d{0,2},\d{3}")


@dataclass(frozen=True)
class PlainTable:
    """A CSV file with commas between cells, points in numbers, and without quotes.

    Attributes:
        headings: text of the line of headings, as written.
        line: number of that line in the file.
        body: the rows below it; line breaks are those of the file.
        notes: how the file is written, where it is not plain.
    """

    headings: str
    separator: str
    line: int
    body: bytes
    notes: tuple[str, ...]


def csv_bytes(path: Path) -> bytes:
    """Return the text of a ``.csv`` or ``.csv.gz`` file.

    Raises:
        FormatError: the name ends in ``.gz``, but the content is no gzip file.
        LimitError: beyond ``limits.CSV``.
    """
    data = read_bytes(path, limits.CSV.file_bytes)
    if not path.name.lower().endswith(GZIP_SUFFIX):
        return data
    allowed = max(limits.CSV.unpacked_free_bytes, limits.CSV.unpacked_ratio * len(data))
    allowed = min(limits.CSV.file_bytes, allowed)
    blocks, size = [], 0
    try:
        while data:
            member = zlib.decompressobj(wbits=31)
            while not member.eof:
                block = member.decompress(data, _BLOCK_BYTES)
                data = member.unconsumed_tail
                if not block and not data and not member.eof:
                    raise FormatError(
                        "ends inside the compressed data", path=path, expected="a whole gzip file"
                    )
                size += len(block)
                require_at_most(
                    size, allowed, "too large after decompression", unit="bytes", path=path
                )
                blocks.append(block)
            data = member.unused_data
    except zlib.error as error:
        raise FormatError(f"not a gzip file: {error}", path=path) from None
    return b"".join(blocks)


def plain_table(path: Path, data: bytes) -> PlainTable:
    """Return the headings and the rows of a CSV file in one form.

    Args:
        path: the file, for errors.

    Raises:
        FormatError: no headings, a quote that does not end, or numbers that may be read in two
            ways.
        LimitError: beyond ``limits.CSV``.
    """
    headings, separator, line, body = _split(path, data.removeprefix(b"\xef\xbb\xbf"))
    notes = []
    plain = _outside_quotes(headings)
    if not separator and b'"' not in body and not any(map(plain.count, _SEPARATORS)):
        cells = headings.split()
        row = _TEXT.search(body)
        if (
            row is not None
            and len(cells) == len(body[row.start() :].split(b"\n", 1)[0].split()) > 1
        ):
            headings, separator, body = ";".join(cells), ";", _without_spaces(body)
            notes.append("columns are separated by spaces")
    separator = separator or max(_SEPARATORS, key=plain.count)
    if b'"' in body:
        body, comma = _unquoted(path, body, separator, line + 1)
    else:
        comma = separator != "," and _has_decimal_comma(path, body)
        if comma:
            body = body.replace(b",", b".")
        if separator != ",":
            body = body.replace(separator.encode(), b",")
    if separator != "," and not notes:
        notes.append(f"columns are separated by {_SEPARATORS[separator]}")
    if comma:
        notes.append("numbers have a decimal comma")
    return PlainTable(headings, separator, line, body, tuple(notes))


def _split(path: Path, data: bytes) -> tuple[str, str, int, bytes]:
    """Return the headings, the stated separator or nothing, their line, and the rest.

    Comments before the headings are skipped; headings may themselves be a comment.
    """
    separator, start = "", 0
    for line in range(1, _LINES_BEFORE + 1):
        end = data.find(b"\n", start)
        end = len(data) if end < 0 else end
        require_at_most(
            end - start,
            limits.CSV.header_bytes,
            "the first line is too long",
            unit="bytes",
            path=path,
            line=line,
        )
        text = decode_text(data[start:end], path).strip()
        start = end + 1
        stated = _EXCEL_SEPARATOR.fullmatch(text)
        is_last = _TEXT.search(data, start) is None
        if stated is not None and stated[1] in _SEPARATORS:
            separator = stated[1]
        elif (text and not text.startswith("#")) or is_last or _NUMBER.match(data, start):
            return text.removeprefix("#").strip(), separator, line, data[start:]
    raise FormatError("no headings", path=path, line=line, expected="a line of headings")


def _without_spaces(body: bytes) -> bytes:
    """Rows with semicolons in place of the spaces between cells."""
    return re.sub(rb" +", b";", re.sub(rb"(?m)^ +| +(?=\r?$)", b"", body))


def _outside_quotes(line: str) -> str:
    return "".join(line.split('"')[::2])


def _has_decimal_comma(path: Path, body: bytes) -> bool:
    """Whether numbers have a decimal comma.

    Raises:
        FormatError: some have a comma and others a point, or all commas may separate thousands.
    """
    comma = _COMMA_NUMBER.search(body)
    if comma is None:
        return False
    point = _POINT_NUMBER.search(body)
    if point is not None:
        raise FormatError(
            "numbers have commas and points", path=path,
            value=f"{comma[0].decode()} and {point[0].decode()}",
            expected="one decimal mark, and nothing between thousands",
        )  # fmt: skip
    if all(_THOUSANDS.fullmatch(number[0]) for number in _COMMA_NUMBER.finditer(body)):
        raise FormatError(
            "the comma may be a decimal mark or separate thousands", path=path,
            value=comma[0].decode(), expected="numbers with a decimal point",
        )  # fmt: skip
    return True


def _unquoted(path: Path, body: bytes, separator: str, first_line: int) -> tuple[bytes, bool]:
    """Rows without quotes and with commas between cells, and whether numbers had a comma."""
    text = io.StringIO(decode_text(body, path), newline="")
    rows = csv.reader(text, delimiter=separator, strict=True)
    lines: list[str] = []
    numbers: list[str] = []
    try:
        for cells in rows:
            if len(lines) + 1 != rows.line_num:
                raise FormatError(
                    "a quoted cell has a line break", path=path, line=first_line + len(lines),
                    expected="one line for each row",
                )  # fmt: skip
            numbers += [cell for cell in cells if "," in cell]
            # Text that is not read may contain any character.
            lines.append(",".join([cell.replace(",", "\0") for cell in cells]))
    except csv.Error as error:
        raise FormatError(
            f"not CSV: {error}", path=path, line=first_line + len(lines),
            expected="quotes around whole cells",
        )  from None  # fmt: skip
    comma = bool(numbers) and _has_decimal_comma(path, "\n".join(numbers).encode())
    plain = "\n".join(lines).encode()
    return plain.replace(b"\0", b"." if comma else b" "), comma
