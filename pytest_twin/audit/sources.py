"""Sources of the values that a file does not state; one source often resolves several findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any


@dataclass(frozen=True, slots=True)
class Source:
    """One document, recording or test that resolves findings.

    Attributes:
        name: name in the JSON report.
        what: description, with the values to look for.
        next_step: what to do with these values.
        codes: findings that it resolves; ``*.what`` applies to every layer.
    """

    name: str
    what: str
    next_step: str
    codes: tuple[str, ...]


SOURCES: tuple[Source, ...] = (
    Source(
        "robot_manual",
        "the robot's manual: axis directions, zero pose, command interface, tool frame",
        "declare them in an evidence file: pytest-twin audit FILE --evidence evidence.yaml",
        (
            "joints.sign_unknown",
            "joints.sign_unclear",
            "joints.zero_unknown",
            "commands.unknown",
            "frames.tool_unknown",
        ),
    ),
    Source(
        "drive_data_sheets",
        "the data sheets of motors, gears and encoders: ratio, rotor inertia, encoder side",
        "state armature (rotor inertia times ratio squared) and gear in the simulator's model",
        (
            "transmissions.unknown",
            "transmissions.unit_reduction",
            "controllers.sensors_unknown",
            "controllers.no_state",
        ),
    ),
    Source(
        "friction_recording",
        "a recording of slow reversals at several speeds, with efforts",
        "fit damping and friction to it: pytest-twin diagnose MODEL RECORDING --out DIR",
        ("joints.friction_unknown",),
    ),
    Source(
        "controller_configuration",
        "the configuration of the controller: gains, rates, filters, saturation",
        "state the controller in twin.yaml, under `controllers:`",
        ("controllers.unknown",),
    ),
    Source(
        "mechanism_drawing",
        "the drawing of the mechanism: passive joints, couplings, closed chains",
        "state couplings and closed chains in the simulator's model",
        (
            "coupling.passive",
            "coupling.mimic_force",
            "coupling.differential",
            "coupling.shared_joint",
            "coupling.closed_chains",
        ),
    ),
    Source(
        "installation",
        "the installation: how the base is mounted, and how level it is",
        "measure the tilt of the base with a level, or fit it to gravity torques at three poses",
        ("frames.mount_unknown",),
    ),
    Source(
        "collision_goldens",
        "collision goldens for the pairs of bodies that can meet",
        "add goldens of kind collision_distance to the twin",
        ("meshes.distances_unknown",),
    ),
    Source(
        "corrected_file",
        "a file without the critical findings",
        "correct them and run the audit again",
        ("*.not_looked_at",),
    ),
)
"""Sources that resolve equally many findings are listed in this order."""


@cache
def _by_code() -> Mapping[str, Source]:
    return {code: source for source in SOURCES for code in source.codes}


def source_of(code: str) -> Source | None:
    """Return the source that resolves findings of a code, or None."""
    table = _by_code()
    return table.get(code) or table.get(f"*.{code.partition('.')[2]}")


def findings_by_source(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the findings of ``rows`` that each source resolves, most findings first.

    Only findings of severity ``unknown`` count.
    """
    codes: dict[str, Counter[str]] = {}
    for row in rows:
        source = source_of(str(row["code"]))
        if row["severity"] == "unknown" and source is not None:
            codes.setdefault(source.name, Counter())[str(row["code"])] += 1
    found = [
        {
            "name": source.name,
            "what": source.what,
            "next_step": source.next_step,
            "count": codes[source.name].total(),
            "codes": dict(codes[source.name]),
        }
        for source in SOURCES
        if source.name in codes
    ]
    return sorted(found, key=lambda one: -int(one["count"]))
