"""Description of each joint's recorded signals in a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.signals import Signals


def signal_table(recordings: Sequence[MeasuredRecording], signals: Signals) -> dict[str, Any]:
    """Return joint -> stated position, effort, gear and zero, and detected rate.

    ``effort_used`` is true if a recording has a measured effort of the joint.

    Args:
        recordings: recordings of the same joints.
        signals: signals that the twin states.
    """
    found: dict[str, Any] = {}
    for column, joint in enumerate(recordings[0].joints):
        own = signals.of(joint)
        found[joint] = {
            "position": asdict(own.position),
            "effort": asdict(own.effort),
            "gear": own.gear,
            "zero": own.zero,
            "shared_with": None if own.shared is None else own.shared.joint,
            "rate": min(one.rate for one in recordings),
            "effort_used": any(bool(np.isfinite(m.effort[:, column]).any()) for m in recordings),
        }
    return found
