"""Findings if the recordings do not determine the interpolation of commands between stamps.

The uncertainty of a delay then includes the differences between the assumptions: half a command
period more for interpolated and half a period less for ramped setpoints.
"""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.findings import Estimate, Explanation, Finding
from pytest_twin.diagnosis.signal_meaning.command_interpolation import CommandInterpolation
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION
from pytest_twin.effects.actuation import ActuatorLag
from pytest_twin.effects.timing import CommandDelay, SensorDelay

_TIMES = {
    CommandDelay.id: "delay",
    SensorDelay.id: "delay",
    ActuatorLag.id: "time_constant",
}
"""Effect -> its parameter that depends on the interpolation of the commands, a time."""
_TEST = (
    "state in the metadata or in twin.yaml what commands do between their stamps "
    "(command_between), or log the controller's own setpoint at its own rate"
)


def with_interpolation_uncertainty(
    explanation: Explanation, undetermined: CommandInterpolation | None
) -> Explanation:
    """The findings with intervals of times that include all possible interpolations.

    Args:
        explanation: findings that were fitted with held commands.
        undetermined: the undetermined answer; None if the interpolation is known.
    """
    if undetermined is None:
        return explanation
    less, more = undetermined.delay_change(undetermined.assumed)
    findings = [
        _widen_interval(f, less, more) if f.effect in _TIMES else f for f in explanation.findings
    ]
    return replace(explanation, findings=tuple(findings))


def _widen_interval(finding: Finding, less: float, more: float) -> Finding:
    """A finding whose time may be smaller by ``-less`` or larger by ``more``, s."""
    name = _TIMES[finding.effect]
    time = finding.parameters[name]
    wide = Estimate(time.value, time.unit, max(time.low + less, 0.0), time.high + more)
    finding = replace(finding, parameters={**finding.parameters, name: wide})
    if time.low + less > 0.0:
        return finding
    # A ramped setpoint without any delay explains the recordings equally well.
    return replace(
        finding, confidence=min(finding.confidence, INTERPOLATION.most_doubted), next_test=_TEST
    )
