"""Progress lines of long work in a log file."""

from __future__ import annotations

import pytest

from pytest_twin.report import progress_log
from pytest_twin.report.progress_log import ProgressLog


def test_each_minute_a_line_states_fraction_time_left_and_stage(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 0.0
    monkeypatch.setattr(progress_log.time, "monotonic", lambda: now)
    log = ProgressLog("diagnosing")
    said = []
    for seconds, fraction in ((30.0, 0.1), (61.0, 0.2), (90.0, 0.3), (125.0, 0.5)):
        now = seconds
        said.append(log.line(fraction, "searching for effects"))
    assert said == [
        None,
        "diagnosing  20 % after 1 min, about 4 min left: searching for effects",
        None,
        "diagnosing  50 % after 2 min, about 2 min left: searching for effects",
    ]
