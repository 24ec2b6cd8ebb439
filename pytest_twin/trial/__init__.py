"""Convert recordings to trials: one clock, the model's joint names, doubtful samples marked."""

from __future__ import annotations

from pytest_twin.recording_options import CommandBetween, CommandMode
from pytest_twin.trial.gaps import stretches
from pytest_twin.trial.make import make_trial, make_trials
from pytest_twin.trial.read import recording_at, recordings_at
from pytest_twin.trial.single_state import at_command_stamps, predicted_rows
from pytest_twin.trial.trial import Mark, MarkKind, Trial

__all__ = [
    "CommandBetween",
    "CommandMode",
    "Mark",
    "MarkKind",
    "Trial",
    "at_command_stamps",
    "make_trial",
    "make_trials",
    "predicted_rows",
    "recording_at",
    "recordings_at",
    "stretches",
]
