"""Every finding states the fault, its consequence and the next step."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from audited import changed, findings_of, robots, write_clean

from pytest_twin.audit.audit_file import audit_file
from pytest_twin.audit.sources import source_of, sources
from pytest_twin.report.audit import table

VAGUE = re.compile(r"\b(stands|told|settled by|as it came|gives way|beyond any number)\b")


@pytest.fixture(
    scope="module", params=["*/*/ur5_robot.urdf", "*/*/allegro_right_hand.urdf", "*/*/pr2.urdf"]
)
def rows(request: pytest.FixtureRequest) -> list[dict[str, object]]:
    return findings_of(next(robots().glob(request.param)))


def test_every_finding_has_a_title_a_consequence_and_a_next_step(
    rows: list[dict[str, object]],
) -> None:
    lacking = {row["code"] for row in rows if not (row["title"] and row["why"] and row["settle"])}
    assert lacking == set()


def test_findings_contain_no_vague_words(rows: list[dict[str, object]]) -> None:
    for row in rows:
        for field in ("title", "why", "settle", "expected"):
            words = str(row[field] or "")
            assert not VAGUE.search(words), words
            assert not words.endswith("."), words
            assert len(words) < 240, words


def test_every_number_in_a_finding_has_a_unit(rows: list[dict[str, object]]) -> None:
    lacking = {row["code"] for row in rows if isinstance(row["value"], float) and not row["unit"]}
    assert lacking == set()


def test_every_unknown_property_names_a_source_of_information(
    rows: list[dict[str, object]],
) -> None:
    unknown = {str(row["code"]) for row in rows if row["severity"] == "unknown"}
    assert unknown
    assert {code for code in unknown if source_of(code) is None} == set()


def test_every_finding_code_has_one_source() -> None:
    codes = [code for source in sources() for code in source.codes]
    assert len(codes) == len(set(codes))


def test_the_report_lists_faults_first_and_unknown_properties_by_source(tmp_path: Path) -> None:
    text = changed(
        (
            '<inertia ixx="0.0012" iyy="0.0156" izz="0.0156" ixy="0" ixz="0" iyz="0"/>',
            '<inertia ixx="1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>',
        ),
        ('velocity="2" effort="20"', 'velocity="2"'),
    )
    found = audit_file(str(write_clean(tmp_path, text)))
    said = table(found)
    places = [
        said.index(words)
        for words in (
            "X inertia.triangle: link 'upper'",
            "! joints.no_effort: joint 'elbow'",
            "properties are not stated in the file (--all lists each). Their sources:",
            "?    9  the robot's manual: axis directions, zero pose, command interface, tool frame",
            "        joints.sign_unknown (3), joints.zero_unknown (3), commands.unknown (3)",
            "        next: declare them in an evidence file",
        )
    ]
    assert places == sorted(places)
    assert "joints.sign_unknown: joint 'elbow'" not in said
    assert "joints.sign_unknown: joint 'elbow'" in table(found, every=True)
    assert sum(source["count"] for source in found["sources"]) == found["counts"]["unknown"]
