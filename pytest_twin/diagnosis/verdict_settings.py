"""Thresholds on residuals: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class VerdictSettings:
    """Thresholds for three decisions: a residual is noise, it is explained, an effect is reported.

    They were chosen on simulated development cases and recordings of real arms. Floors are
    multiples of a signal's noise floor; shares are of a squared error above the floor.

    Attributes:
        at_floor: floors up to which an RMS residual counts as noise. The floor is an estimate, and
            micro-slip of real joints and MuJoCo's soft contacts leave residuals of 2 to 3 floors.
        identifiable: floors below which a signal contains no identifiable effect.
        left: share of the squared error up to which a search may end, ...
        left_floors: ... if the residual is also below this many floors. Above, it is a mismatch of
            its own.
        of_travel: share of a joint's travel up to which an error is of no consequence where small
            corrections of the model explain it: 1 mrad of 1 rad is at the repeatability of ordinary
            arms.
    """

    at_floor: float = 3.0
    identifiable: float = 1.5
    left: float = 0.02
    left_floors: float = 10.0
    of_travel: float = 1e-3


VERDICT = VerdictSettings()
