"""Meaning of the recorded signals, determined before the search for effects.

Examples are setpoints that move between logged commands, velocities that the driver differenced,
and efforts that were demanded instead of measured. A wrong assumption would lead to wrong effects.
Each module answers one question, with confidence and evidence in words. If the data do not
determine the answer it is None, and later steps do not depend on it.
"""

from pytest_twin.diagnosis.signal_meaning.command_between import Between
from pytest_twin.diagnosis.signal_meaning.doubt import with_doubt
from pytest_twin.diagnosis.signal_meaning.reconsidered import with_fewer_effects
from pytest_twin.diagnosis.signal_meaning.recorded_signals import RecordedSignals, determine_signals

__all__ = ["Between", "RecordedSignals", "determine_signals", "with_doubt", "with_fewer_effects"]
