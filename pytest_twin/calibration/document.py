"""What every ``calibration.json`` has."""

from __future__ import annotations

from typing import Any

from pytest_twin import __version__
from pytest_twin.calibration.plan import Plan


def new_document(plan: Plan) -> dict[str, Any]:
    """Return the content of ``calibration.json`` before anything is estimated."""
    return {
        "schema": 1,
        "calibration": plan.id,
        "verdict": "degenerate",
        "records": {},
        "held_out": {"count": 0},
        "fitted": {"count": 0},
        "solvers": {},
        "excluded": [],
        "unobservable": [],
        "suspected": [],
        "reasons": [],
        "notes": [],
        "software": {"pytest-twin": __version__},
    }
