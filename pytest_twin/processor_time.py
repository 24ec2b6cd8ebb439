"""Processor time, which other programs on the machine do not lengthen."""

from __future__ import annotations

import os


def processor_seconds() -> float:
    """Processor time of this process and its ended children, s."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system
