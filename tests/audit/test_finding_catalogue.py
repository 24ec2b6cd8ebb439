"""The catalogue of findings lists what the audit finds, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

from pytest_twin import audit
from pytest_twin.asset.urdf_elements import ENTRIES
from pytest_twin.audit.finding import LAYERS, PLANNING, SEVERITIES, SIMREADY, catalogue, finding_of


def test_catalogue_and_code_name_the_same_findings() -> None:
    sources = [file.read_text() for file in Path(audit.__path__[0]).rglob("*.py")]
    made = {code for text in sources for code in re.findall(r'finding_of\(\s*"([\w.]+)"', text)}
    made |= {entry.goes.code for entry in ENTRIES if entry.goes.code is not None}
    listed = {f"{layer}.{name}" for layer, names in catalogue().items() for name in names}
    assert made == listed
    assert set(catalogue()) <= {*LAYERS, SIMREADY, PLANNING}


def test_every_entry_has_a_known_severity_or_leaves_it_to_the_code() -> None:
    for names in catalogue().values():
        for fields in names.values():
            assert fields.get("severity", SEVERITIES[0]) in SEVERITIES
            assert set(fields) <= {"severity", "title", "unit", "expected", "why", "settle"}


def test_what_depends_on_the_robot_replaces_what_the_catalogue_states() -> None:
    made = finding_of("joints.axis_not_unit", None, "joint 'elbow'", 2.0, severity="info")
    assert (made.severity, made.value, made.unit) == ("info", 2.0, "1")
    assert made.title == "its axis is not a unit vector"
