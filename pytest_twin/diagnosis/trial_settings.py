"""Settings of recordings that become trials: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class TrialSettings:
    """Thresholds by which recordings are held out, refused, or noted.

    They were chosen on recordings of real arms, and on simulated ones with one mistake each.

    Attributes:
        one_held_out_of: one of this many recordings is held out if neither the user nor the
            metadata chooses.
        stuck_share: share of a recording with a constant position under a moving command from which
            an encoder counts as stuck.
        held_sweep: dry friction holds a joint against a limited tracking error. If the error varies
            this many times as much as during motion, the joint would have moved, so its encoder is
            stuck.
        least_travel: an encoder that has moved less, rad or m, is not known to work.
        far_travel: travel of a hinge, rad, from which a note asks for its unit.
        fewest_samples: smallest number of states with different stamps from which sensor noise can
            be estimated.
        shortest_part: shortest part of a recording, s. A shorter one shows little apart from its
            initial state.
        clipped_share: share of messages with exactly the largest speed from which a velocity counts
            as clipped.
    """

    one_held_out_of: int = 4
    stuck_share: float = 0.6
    held_sweep: float = 2.0
    least_travel: float = 0.2
    far_travel: float = 8.0 * np.pi
    fewest_samples: int = 8
    shortest_part: float = 1.0
    clipped_share: float = 0.02


@dataclass(frozen=True, slots=True)
class RangeSettings:
    """Thresholds on the range of time constants and speeds that recordings determine.

    Attributes:
        longest_constant: largest identifiable time constant, in multiples of the longest recording.
            A transient with three times its duration is 28 % complete; of a longer one only the
            initial slope is visible.
        moving_share: share of its largest speed above which a joint moves.
        distance_quantile: quantile of the distances between samples, while the joint moves, that
            counts as their distance.
        fewest_samples: smallest number of samples that a range of speeds must contain.
    """

    longest_constant: float = 3.0
    moving_share: float = 0.05
    distance_quantile: float = 0.25
    fewest_samples: int = 5


@dataclass(frozen=True, slots=True)
class UnitSettings:
    """Thresholds by which a replay shows that hinge positions are not in rad.

    They were chosen on recordings of real arms that were written in degrees and in counts.

    Attributes:
        least_travel: smallest travel in rad of every moving hinge for a test of the unit.
        moves: smallest travel in rad of a moving hinge.
        seconds_on: duration in s for which the replay goes on after a hinge has moved far.
        fails: smallest RMS error relative to the RMS motion, and in rad in some recording. A servo
            follows slow motion in any unit.
        follows: largest relative RMS error in the other unit.
        closer: largest ratio of both relative RMS errors.
        counts_closer: factor on ``closer`` for counts: degrees are far more common.
    """

    least_travel: float = 2.0 * np.pi
    moves: float = 1e-6
    seconds_on: float = 0.3
    fails: float = 0.5
    follows: float = 0.3
    closer: float = 0.25
    counts_closer: float = 0.5


TRIALS = TrialSettings()
RANGES = RangeSettings()
UNIT_CHECK = UnitSettings()
