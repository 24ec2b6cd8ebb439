"""Sources that settle what a file leaves unknown, each many findings at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any


@dataclass(frozen=True, slots=True)
class Source:
    """One document, recording or test.

    Attributes:
        name: in the JSON.
        what: as people call it, with what to look for in it.
        next_step: what to do with it.
        codes: findings that it settles; ``*.what`` for those of every layer.
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
"""In the order in which they are listed where they settle equally many findings."""


@cache
def _by_code() -> Mapping[str, Source]:
    return {code: source for source in SOURCES for code in source.codes}


def source_of(code: str) -> Source | None:
    """The source that settles findings of a code; None where none is known."""
    table = _by_code()
    return table.get(code) or table.get(f"*.{code.partition('.')[2]}")


def settled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What each source settles of the findings ``rows``, the source of most of them first.

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
