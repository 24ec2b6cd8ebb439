"""Report line that compares the results of two simulators for one golden."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pytest_twin.gate.authority import difference_lines
from pytest_twin.outcome import Measure, Outcome


def report_line(measured: float, error: float = 0.0, time: float | None = None) -> str:
    golden = SimpleNamespace(id="fk/tool", realizations=("mujoco", "supplier"))
    outcomes = {
        f"fk/tool@{name}": Outcome(
            golden="fk/tool", kind="fk", realization=name, criticality="critical", status="passed",
            measures=(Measure("position", "tcp", value, 1.0, off, 0.01, "m", time=time),),
        )
        for name, value, off in (("mujoco", 1.0, 0.0), ("supplier", measured, error))
    }  # fmt: skip
    (line,) = difference_lines([golden], outcomes, {"mujoco": "mujoco", "supplier": "mujoco"})
    return line


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        (1.0 + 1e-12, "which is authoritative: the same to within 0.1 % of the tolerance"),
        (1.001, "position of tcp 1.001 m and 1 m, 0.001 m apart, 10 % of the tolerance"),
    ],
)
def test_a_difference_is_reported_only_above_0_1_percent_of_the_tolerance(
    measured: float, words: str
) -> None:
    assert words in report_line(measured)


def test_series_are_compared_by_their_errors_as_their_worst_samples_are_at_different_times() -> (
    None
):
    words = report_line(0.2, error=0.001, time=0.4)
    assert "position of tcp off by 0.001 m and 0 m, 0.001 m apart, 10 % of the tolerance" in words
