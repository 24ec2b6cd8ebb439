"""Settings of small corrections and physical totals: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CorrectionSettings:
    """Thresholds below which a correction is of no consequence, or within its accuracy.

    Attributes:
        of_mismatch: share of the nominal model's error below which a change of a prediction is of
            no consequence: 1 % of the squared error.
        of_sample: share of the sampling interval, the resolution of the stamps, below which a shift
            in time is of no consequence.
        of_own: usual relative accuracy of friction, armature and spring stiffness (Janot et al.
            2019 repeat identifications within 5 to 10 %).
        of_gain: usual relative accuracy of gains and motor constants in data sheets.
        of_body: usual relative accuracy of masses and inertias in CAD models.
        below_zero: share of the model's value by which a total may be below zero, the accuracy of a
            correction that removes all of it (1.7 % if damping of 0.1 N m s/rad was removed from
            simulated recordings).
        below_zero_of_typical: share of the typical size of the correction, such as the drive's RMS
            effort, by which a total may also be below zero. It matters if the model's value is
            zero.
    """

    of_mismatch: float = 0.1
    of_sample: float = 0.25
    of_own: float = 0.1
    of_gain: float = 0.02
    of_body: float = 0.03
    below_zero: float = 0.05
    below_zero_of_typical: float = 0.01


CORRECTIONS = CorrectionSettings()
