"""Recordings with the meaning of their signals, and the effects that a search finds in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.diagnosis.budget import SEARCH_SHARE
from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.prepare import shared_joints
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search_recordings import find_structure
from pytest_twin.diagnosis.signal_meaning import RecordedSignals, determine_signals
from pytest_twin.diagnosis.signal_meaning.command_interpolation import CommandInterpolation
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.windows import Cutting, segments_of
from pytest_twin.realization import Realization


@dataclass(frozen=True, slots=True)
class SearchedTrials:
    """The effects that a search found, before any test recording is used.

    Attributes:
        signals: meaning of the recorded commands, velocities and efforts.
        trials: all recordings as they are used.
        structure: the effects that were found.
        undetermined: interpolation of the commands that neither signals nor effects decide.
    """

    signals: RecordedSignals
    trials: TrialSet
    structure: ChosenModel
    undetermined: CommandInterpolation | None


def search_trials(
    realization: Realization,
    trials: TrialSet,
    run: Run,
    *,
    inherited: PatchedModel | None = None,
    threads: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
) -> SearchedTrials:
    """Determine the meaning of the signals, and search the effects, without test recordings.

    Arguments and errors are those of :func:`~pytest_twin.diagnosis.diagnose.diagnose`.
    """
    setup, known = ModelSetup.of(realization, inherited, threads), replace(trials, held_out=())
    with run.budget.searching(SEARCH_SHARE):
        signals = run.attempt(
            "what the commands and efforts of the recordings are",
            lambda: determine_signals(setup, known), RecordedSignals(),
        )  # fmt: skip
    as_recorded, trials = trials, signals.apply(trials)
    undetermined = signals.undetermined(trials.fit)
    for i, trial in enumerate(trials.held_out):
        # A test recording that the model cannot replay is reported before the search of minutes.
        joints = shared_joints(realization, [trial])
        segments_of(realization, trial, i, joints, Cutting(skips_hole=True))
    # Simulations of candidates may diverge and overflow; such candidates are ranked last.
    with np.errstate(over="ignore", invalid="ignore"):
        structure = find_structure(
            realization, replace(trials, held_out=()),
            inherited=inherited, threads=threads, run=run, progress=progress,
            possible=() if undetermined is None else undetermined.possible,
        )  # fmt: skip
    if undetermined is not None and structure.between is not None:
        signals = signals.with_decision(undetermined, structure.between)
        trials, undetermined = signals.apply(as_recorded), None
    return SearchedTrials(signals, trials, structure, undetermined)
