"""Table of all elements and attributes of URDF files, and where each is converted to.

The table is ``urdf_elements.csv``. Sources: urdfdom's ``urdf.xsd`` and parser (with the limits of
URDF 1.2), the draft of URDF sensors, the SRDF specification of MoveIt, ros_control's and
ros2_control's component parsers, the extension tags of sdformat's URDF parser, MuJoCo's block in a
URDF, and PyBullet's contact elements.

Paths are relative to ``robot``. A final ``/**`` means the element with all its descendants, a
final ``/*`` every other child.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib import resources

TEXT = "text()"
"""Represents the text of the element instead of an attribute."""


@dataclass(frozen=True, slots=True)
class Destination:
    """How realizations represent an element or attribute.

    Attributes:
        row: row of the semantic-loss matrix, None if every realization preserves it.
        code: code of the audit finding, None if the row suffices.
    """

    row: str | None = None
    code: str | None = None


CARRIED = Destination()
NAMES = Destination()
"""Preserved as a name or structure that other elements refer to."""
APPLIED = Destination()
"""Applied to the robot before it is written, so that every realization includes it."""
DESTINATIONS = {
    "carried": CARRIED,
    "names": NAMES,
    "applied": APPLIED,
    "speeds": Destination("velocity limits"),
    "soft_limits": Destination("safety controllers"),
    "reductions": Destination("transmissions"),
    "sensors": Destination("sensors"),
    "contact": Destination("contact materials", "meshes.contact_setting"),
    "drive": Destination("drive elements", "transmissions.drive_element"),
    "calibration": Destination("joint calibration", "joints.calibration"),
    "dynamic_limits": Destination("acceleration limits", "joints.dynamic_limit"),
    "quaternion": Destination("orientations as quaternions", "frames.quaternion"),
    "interfaces": Destination("controller interfaces", "controllers.interface_setting"),
    "simulator": Destination("simulator settings", "controllers.simulator_setting"),
    "planning": Destination("planning settings", "controllers.planning_setting"),
    "description": Destination("descriptive elements", "controllers.descriptive"),
    "sensor_settings": Destination("sensor settings", "controllers.sensor_setting"),
}
"""Name in the table -> destination."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One element or attribute.

    Attributes:
        path: below ``robot``, ``joint/limit``.
        attribute: its name, :data:`TEXT` for the element's text, None for the element itself.
        sample: a valid value other than its default.
        neutral: a value without effect, None if every value has an effect.
        is_physical: whether it affects the robot's motion.
    """

    path: str
    attribute: str | None
    sample: str
    goes: Destination
    neutral: str | None = None
    is_physical: bool = False

    @property
    def label(self) -> str:
        """Return ``path@attribute``, such as ``joint/limit@lower``, or only the path."""
        alone = self.attribute in (None, TEXT)
        return self.path if alone else f"{self.path}@{self.attribute}"


def _entries() -> tuple[Entry, ...]:
    text = resources.files(__package__).joinpath("urdf_elements.csv").read_text("utf-8")
    return tuple(
        Entry(
            path=row["path"],
            attribute=row["attribute"] or None,
            sample=row["sample"],
            goes=DESTINATIONS[row["destination"]],
            neutral=row["neutral"] or None,
            is_physical=bool(row["physical"]),
        )
        for row in csv.DictReader(text.splitlines())
    )


ENTRIES = _entries()


@cache
def by_path() -> dict[tuple[str, str | None], Entry]:
    """Return (path, attribute) -> its entry."""
    return {(entry.path, entry.attribute): entry for entry in ENTRIES}


@cache
def known_paths() -> frozenset[str]:
    """Return all paths of the table and their parents."""
    found: set[str] = set()
    for entry in ENTRIES:
        parts = entry.path.removesuffix("/**").removesuffix("/*").split("/")
        found.update("/".join(parts[: end + 1]) for end in range(len(parts)))
    return frozenset(found)
