"""Elements and attributes of a URDF that no realization preserves, or that no format defines."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.asset.stated_elements import StatedElement, is_neutral, stated_elements
from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, Place, finding_of

_SHOWN = 4
"""Largest number of values that a finding lists."""


def check(asset: Asset) -> Iterator[Finding]:
    """Yield one finding for each kind of element, with its first place and its values."""
    yield from _custom(asset)
    if asset.kind != "urdf" or asset.root is None:
        return
    kinds: dict[str, list[StatedElement]] = {}
    for one in stated_elements(asset.root):
        if one.entry is not None and one.entry.goes.code is not None and not is_neutral(one):
            kinds.setdefault(one.label, []).append(one)
    for label, found in kinds.items():
        yield _left_out(label, found)


def _left_out(label: str, found: list[StatedElement]) -> Finding:
    first = found[0]
    assert first.entry is not None
    goes = first.entry.goes
    assert goes.code is not None
    values = list(dict.fromkeys(f"{one.owner} {one.value}".strip() for one in found))
    shown = ", ".join(values[:_SHOWN])
    more = f" and {len(values) - _SHOWN} more" if len(values) > _SHOWN else ""
    count = "once" if len(found) == 1 else f"{len(found)} times"
    return finding_of(
        goes.code,
        Place(first.node.path, first.node.line),
        label,
        shown + more,
        severity="warning" if first.entry.is_physical else "info",
        title=f"stated {count}, and no realization preserves it",
    )


def _custom(asset: Asset) -> Iterator[Finding]:
    for label, places in sorted(asset.custom.items()):
        what = "attribute" if "@" in label else "element"
        count = "once" if len(places) == 1 else f"{len(places)} times"
        yield finding_of(
            "controllers.custom_tag",
            places[0],
            label,
            float(len(places)),
            title=f"an {what} that neither URDF, SRDF, ros2_control nor Gazebo defines, "
            f"stated {count}",
            unit=f"{what}s",
        )
