"""Run the complete audit of an SRDF, in the child process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pytest_twin.audit import finding, self_collision
from pytest_twin.audit.finding import PLANNING, Finding
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read
from pytest_twin.audit.srdf import collisions, elements, groups, states
from pytest_twin.audit.srdf.document import Srdf
from pytest_twin.audit.srdf.files import urdf_of
from pytest_twin.errors import ModelError
from pytest_twin.realization import urdf
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings


def audit_srdf(
    path: str,
    urdf_path: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Return the JSON report of an SRDF, in the same form as that of a URDF.

    Args:
        urdf_path: its URDF; None to search for it near the SRDF.

    Raises:
        TwinError: the SRDF or its URDF cannot be read, or no URDF is found.
    """
    say = progress or (lambda fraction: None)
    source = Path(path)
    with suppress_mujoco_warnings():
        root = urdf.document(source)
        if root.all("link"):
            raise root.error("a URDF, not an SRDF", expected="an SRDF: a <robot> without <link>")
        name = root.attributes.get("name", "")
        robot = urdf_of(source, name) if urdf_path is None else Path(urdf_path)
        asset = read(robot)
        if asset.kind != "urdf":
            raise ModelError("not a URDF", path=robot, expected="the URDF of the SRDF")
        say(0.4)
        srdf = Srdf(root, asset)
        geometry = Geometry(asset)
        found = check(srdf)
        results, more = collisions.measure_distances(srdf, geometry)
    say(0.8)
    report = _report(srdf, [*found, *more])
    report["poses"] = self_collision.to_json(results)
    located = asset.located
    report["located"] = [f"URDF: {robot}", *(() if located is None else located.words())]
    say(1.0)
    return report


def check(srdf: Srdf) -> list[Finding]:
    """Return every finding that needs no geometry."""
    return [
        *groups.check(srdf),
        *states.check(srdf),
        *collisions.check(srdf),
        *elements.check(srdf),
    ]


def _report(srdf: Srdf, findings: list[Finding]) -> dict[str, Any]:
    name = srdf.root.attributes.get("name", "")
    return {
        **finding.report_of(srdf.root.path, "srdf", name, findings, [PLANNING]),
        "facts": {
            "urdf": str(srdf.asset.path),
            "groups": len(srdf.groups),
            "states": len(srdf.root.all("group_state")),
            "end_effectors": len(srdf.root.all("end_effector")),
            "disabled_pairs": len(srdf.root.all("disable_collisions")),
        },
    }
