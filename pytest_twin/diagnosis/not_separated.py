"""List the names between which recordings cannot decide, and the command for a motion that can."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_twin.effects import catalogue

NEEDED_SHARE = 0.9
"""Share of the probability that the listed names have together."""
_LIKELY = 1.0 - NEEDED_SHARE
"""Smallest probability of a name in the list, where even all names together have less than 90 %."""


def state_not_separated(document: dict[str, Any], model: Path, folder: Path) -> None:
    """Add ``not_separated`` and the command to the findings of a diagnosis, in place.

    Where no change has a name, the command is the ``next_test`` of the document.

    Args:
        document: content of ``diagnosis.json``.
        model: MODEL of the command.
        folder: folder of the diagnosis.
    """
    for finding in document["findings"]:
        names = not_separated(finding)
        if not names:
            continue
        shares = [one["confidence"] for one in names]
        stated: dict[str, Any] = {"names": names, "share": round(min(sum(shares), 1.0), 4)}
        command = _command([one["name"] for one in names], model, folder)
        if command:
            stated["command"] = command
            finding["next_test"] = f"{finding['next_test'].rstrip('.')}; or {command}"
        finding["not_separated"] = stated
    of_joints = [one for one in document.get("candidates", []) if one["motor"] is None]
    if command := _command(["+".join(_names(one)) for one in of_joints], model, folder):
        document["next_test"] = command


def _command(names: Sequence[str], model: Path, folder: Path) -> str:
    """Command for the motion that separates the two likeliest names; empty where none can."""
    pair = [name for name in names if _is_of_a_motion(name)][:2]
    if len(pair) < 2:
        return ""
    return shlex.join([
        "pytest-twin", "excite", _from_here(model), "--separate", ",".join(pair),
        "--diagnosis", _from_here(folder), "--out", "separating_motion",
    ])  # fmt: skip


def not_separated(finding: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the likeliest names, until they have 90 % of the probability; empty for one name.

    Each has ``name`` (``EFFECT@JOINT``; several effects joined by ``+``) and ``confidence``.
    """
    names = [
        {"name": "+".join(_names(one)), "confidence": one["confidence"]}
        for one in (finding, *finding["alternatives"])
    ]
    of_finding = names[0]
    names.sort(key=lambda one: -float(one["confidence"]))
    share = 0.0
    for count, one in enumerate(names, 1):
        share += one["confidence"]
        if share >= NEEDED_SHARE:
            listed = names[:count]
            # The finding's own name is listed, even where the others have the 90 %.
            listed += [] if of_finding in listed else [of_finding]
            return listed if len(listed) > 1 else []
    likely = [one for one in names if one["confidence"] >= _LIKELY]
    return likely if len(likely) > 1 else []


def _names(item: Mapping[str, Any]) -> Iterator[str]:
    for one in (item, *item.get("together_with", ())):
        yield one["effect"] if one.get("joint") is None else f"{one['effect']}@{one['joint']}"


def _is_of_a_motion(name: str) -> bool:
    """Whether ``excite --separate`` takes the name: one effect that a free motion can show."""
    law = catalogue().get(name.split("@")[0])
    return "+" not in name and law is not None and law.candidate and law.family != "contact"


def _from_here(path: Path) -> str:
    """The path from the working folder, absolute if it is elsewhere."""
    path = path.absolute()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
