"""Findings where the recordings cannot tell what commands do between stamps.

A delay is then known no better than the assumptions differ by: half a command period to a
setpoint that moves on, half a period the other way to one that ramps.
"""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.findings import Estimate, Explained, Finding
from pytest_twin.diagnosis.recorded.command_between import Between
from pytest_twin.effects.actuation import ActuatorLag
from pytest_twin.effects.timing import CommandDelay, SensorDelay

_TIMES = {
    CommandDelay.id: "delay",
    SensorDelay.id: "delay",
    ActuatorLag.id: "time_constant",
}
"""Effects with a time that a setpoint between stamps changes, and that time."""
_DOUBTED = 0.5
"""Largest confidence of a time that the setpoint alone may explain: one in two."""
_TEST = (
    "state in the metadata or in twin.yaml what commands do between their stamps "
    "(command_between), or log the controller's own setpoint at its own rate"
)


def with_doubt(explained: Explained, open_: Between | None) -> Explained:
    """The same with findings whose times have intervals that allow for every possible setpoint.

    Args:
        explained: fitted with held commands.
        open_: the answer that cannot tell; None where commands are known.
    """
    if open_ is None:
        return explained
    less, more = open_.later("held")
    findings = [_doubted(f, less, more) if f.effect in _TIMES else f for f in explained.findings]
    return replace(explained, findings=tuple(findings))


def _doubted(finding: Finding, less: float, more: float) -> Finding:
    name = _TIMES[finding.effect]
    time = finding.parameters[name]
    wide = Estimate(time.value, time.unit, max(time.low + less, 0.0), time.high + more)
    finding = replace(finding, parameters={**finding.parameters, name: wide})
    if time.low + less > 0.0:
        return finding
    # A setpoint that ramps, and no delay at all, explains as much.
    return replace(finding, confidence=min(finding.confidence, _DOUBTED), next_test=_TEST)
