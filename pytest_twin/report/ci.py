"""Write audit findings for continuous integration: SARIF, JUnit, annotations of GitHub."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

from lxml import etree

from pytest_twin import __version__
from pytest_twin.errors import TwinError
from pytest_twin.report.audit import value as value_in_words
from pytest_twin.report.baseline import Key

_SCHEMA = (
    "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"
)
_LEVELS = {"critical": "error", "warning": "warning"}
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class Problem:
    """A finding at its place in a checkout.

    Attributes:
        robot: path of the audited robot, relative to the checkout.
        file: path of the file with the problem, relative to the checkout.
        line: None where it is not known, as for the lines of a xacro file.
    """

    robot: str
    code: str
    severity: str
    element: str
    text: str
    value: str
    file: str
    line: int | None

    @property
    def key(self) -> Key:
        """What identifies the finding in every version of the file."""
        return Key(self.robot, self.code, self.element, self.value)

    @classmethod
    def of_finding(cls, robot: str, row: Mapping[str, Any], root: Path) -> Self:
        """Return the problem of a finding in the JSON of an audit."""
        value = value_in_words(row)
        parts = [f"{row['element']}: {row['title']}"]
        parts += [f"got {value}"] if value else []
        parts += [f"expected {row['expected']}"] if row["expected"] else []
        text = "; ".join(parts) + (f". Next: {row['settle']}" if row["settle"] else "")
        file, line = _place(robot, row["file"], row["line"], root)
        return cls(robot, row["code"], row["severity"], row["element"], text, value, file, line)

    @classmethod
    def of_error(cls, robot: str, error: TwinError, root: Path) -> Self:
        """Return the problem of a robot that cannot be read."""
        file, line = _place(robot, error.path, error.line, root)
        return cls(robot, "unusable", "critical", error.where or "", str(error), "", file, line)

    def line_of_text(self) -> str:
        """Return the problem in a line, with its place first."""
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        return f"{place}: {self.severity}: {self.code}: {self.text}"

    def to_json(self) -> dict[str, Any]:
        """Return the problem as JSON data."""
        return asdict(self)


def _place(robot: str, file: object, line: int | None, root: Path) -> tuple[str, int | None]:
    """File and line in the checkout; the robot where the finding is elsewhere."""
    if file is None:
        return robot, None
    path = Path(str(file)).resolve()
    if not path.is_relative_to(root.resolve()):
        return robot, None
    name = path.relative_to(root.resolve()).as_posix()
    # Lines of a xacro file's findings are those of what it expands to.
    return name, None if name.endswith(".xacro") else line


def sarif(problems: Sequence[Problem]) -> str:
    """Return the problems as SARIF 2.1.0."""
    codes = sorted({one.code for one in problems})
    rules = [{"id": code, "shortDescription": {"text": code.replace(".", ": ").replace("_", " ")}}
             for code in codes]  # fmt: skip
    driver = {"name": "pytest-twin", "semanticVersion": __version__, "rules": rules}
    run = {
        "tool": {"driver": driver},
        "columnKind": "utf16CodeUnits",
        "results": [_result(one, codes.index(one.code)) for one in problems],
    }
    return json.dumps({"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2) + "\n"


def _result(one: Problem, rule: int) -> dict[str, Any]:
    place: dict[str, Any] = {
        "artifactLocation": {"uri": quote(one.file), "uriBaseId": "%SRCROOT%"},
        # GitHub shows no result without a line.
        "region": {"startLine": one.line or 1},
    }
    fingerprint = hashlib.sha256("\0".join(one.key).encode("utf-8", "replace")).hexdigest()
    return {
        "ruleId": one.code,
        "ruleIndex": rule,
        "level": _LEVELS[one.severity],
        "message": {"text": one.text},
        "locations": [{"physicalLocation": place}],
        "partialFingerprints": {"robotCodeElementValue/v1": fingerprint},
    }


def junit(robots: Sequence[str], problems: Sequence[Problem]) -> str:
    """Return one test case for each critical finding, and one for each robot without any."""
    critical = [one for one in problems if one.severity == "critical"]
    failed = {one.robot for one in critical}
    sound = [robot for robot in robots if robot not in failed]
    suite = etree.Element(
        "testsuite", name="pytest-twin audit", tests=str(len(critical) + len(sound)),
        failures=str(len(critical)), errors="0",
    )  # fmt: skip
    for robot in sound:
        etree.SubElement(suite, "testcase", classname="audit", name=_xml(robot))
    for one in critical:
        name = f"{one.robot}: {one.code}: {one.element}"
        case = etree.SubElement(
            suite, "testcase", classname="audit", name=_xml(name), file=_xml(one.file)
        )
        if one.line is not None:
            case.set("line", str(one.line))
        failure = etree.SubElement(case, "failure", message=_xml(one.text))
        failure.text = _xml(one.line_of_text())
    return etree.tostring(suite, encoding="unicode", pretty_print=True)


def _xml(text: str) -> str:
    """Replace characters that XML may not contain."""
    return _NOT_XML.sub("�", text)


def annotation(one: Problem) -> str:
    """Return a workflow command of GitHub, which shows the problem at its line."""
    line = "" if one.line is None else f",line={one.line}"
    return (
        f"::{_LEVELS[one.severity]} file={_property(one.file)}{line},"
        f"title={_property(one.code)}::{_data(one.text)}"
    )


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
