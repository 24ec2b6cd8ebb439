"""Meaning of the recorded signals, determined before the search for effects.

Examples are setpoints that move between logged commands, velocities that the driver differenced,
and efforts that were demanded instead of measured. A wrong assumption would lead to wrong effects.
Each module answers one question, with confidence and evidence in words. If the data do not
determine the answer it is None, and later steps do not depend on it.
"""

from pytest_twin.diagnosis.signal_meaning.command_interpolation import CommandInterpolation
from pytest_twin.diagnosis.signal_meaning.interpolation_uncertainty import (
    with_interpolation_uncertainty,
)
from pytest_twin.diagnosis.signal_meaning.recorded_signals import RecordedSignals, determine_signals

__all__ = [
    "CommandInterpolation",
    "RecordedSignals",
    "determine_signals",
    "with_interpolation_uncertainty",
]
