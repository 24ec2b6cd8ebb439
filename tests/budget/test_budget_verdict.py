"""The verdict of a budget counts errors that no estimate explains."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from budget_files import declared, fit_record, make_twin, record_motion, zeros_record

from pytest_twin.budget.budget_of_twin import budget_of_file

SMALL = [[1e-8, 0.0], [0.0, 1e-8]]
POSITION = "  tolerance: {position: 0.002}\n"


def verdict_of(folder: Path, records: list, tolerance: str = POSITION, fits: list = ()) -> dict:
    twin = make_twin(folder, records, list(fits), declared(more=tolerance))
    return budget_of_file(str(twin))


@pytest.mark.parametrize(
    ("held_out", "verdict", "words"),
    [
        ({"distance_rms": 0.0058}, "exceeded", "5.8 mm of held-out error that no estimate"),
        ({"distance_rms": 0.0005}, "within", "the 95 % bound is below the tolerance"),
        ({"distance_rms": 0.0015}, "unknown", "its 95 % bound above"),
        ({"translation_rms": 0.0012}, "exceeded", "above the tolerance"),
        ({}, "unknown", "no record has a held-out position error"),
    ],
    ids=["unmodelled", "within", "between", "of each coordinate", "nothing held out"],
)
def test_small_uncertainty_of_the_estimates_alone_is_not_within_the_tolerance(
    tmp_path: Path, held_out: dict, verdict: str, words: str
) -> None:
    found = verdict_of(tmp_path, [zeros_record(SMALL, held_out=held_out)])
    assert found["total"]["share"]["position"] < 0.05
    assert found["verdict"] == verdict
    assert found["words"][0].startswith(f"{verdict}: position error")
    assert words in found["words"][0]


def test_the_uncertainty_of_the_estimates_alone_can_exceed_the_tolerance(tmp_path: Path) -> None:
    found = verdict_of(tmp_path, [zeros_record([[1e-4, 0.0], [0.0, 1e-4]])])
    assert found["verdict"] == "exceeded"


def test_without_a_tolerance_nothing_is_within_it(tmp_path: Path) -> None:
    found = verdict_of(tmp_path, [zeros_record(SMALL, held_out={"distance_rms": 1e-5})], "")
    assert found["verdict"] == "unknown"
    assert found["words"] == [
        "unknown: budget: tolerance: of twin.yaml states nothing to compare with"
    ]


def test_the_worst_quantity_decides(tmp_path: Path) -> None:
    """The position is within its tolerance, and no record has a held-out error of the rotation."""
    record = zeros_record(SMALL, held_out={"distance_rms": 1e-4})
    found = verdict_of(tmp_path, [record], "  tolerance: {position: 0.002, rotation: 0.01}\n")
    assert found["bounds"]["position"]["state"] == "within"
    assert found["verdict"] == found["bounds"]["rotation"]["state"] == "unknown"
    assert found["words"][0].startswith("unknown: rotation error")


def test_held_out_error_of_a_record_without_covariance_counts(tmp_path: Path) -> None:
    record = fit_record([], [], [], {"shoulder": 0.01})
    found = verdict_of(
        tmp_path, [zeros_record(SMALL, held_out={"distance_rms": 1e-4})], fits=[record]
    )
    assert found["verdict"] == "exceeded"
    assert found["bounds"]["position"]["unmodelled_of"] == "fitted"


@pytest.mark.parametrize("payload", ["kg05", "kg20"])
def test_a_payload_that_no_record_was_made_with_is_not_within_the_tolerance(
    tmp_path: Path, payload: str
) -> None:
    time = np.arange(0.0, 1.0, 0.01)
    position = 0.2 * np.column_stack([np.sin(3 * time), np.cos(2 * time)])
    record_motion(tmp_path / "task.mcap", position, np.zeros_like(position), payload=payload)
    fit = fit_record(["shoulder.viscous_friction"], [1e-6], ["N*m*s/rad"], {"shoulder": 1e-5})
    fit["basis"] = {
        "model": "", "has_twin": True, "uses": {"payloads": ["kg05"]}, "parts": {}, "files": {},
    }  # fmt: skip
    task = "  recordings: [task.mcap]\n  tolerance: {position: 0.5}\n"
    known = f"payloads: {{{payload}: {{fore: {{mass: 0.5}}}}}}\n"
    found = verdict_of(tmp_path, [zeros_record(SMALL, held_out={"distance_rms": 0.0005})],
        task + known, [fit])  # fmt: skip
    if payload == "kg05":
        assert found["verdict"] == "within"
    else:
        assert found["verdict"] == "unknown"
        assert "the task's recordings have payload 'kg20', under which no" in found["words"][0]
