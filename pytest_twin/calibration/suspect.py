"""A mistake in the input that would explain the errors, as a report states it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FAR_BETTER = 1.0 / 3.0
"""An alternative is named where it leaves less than this part of both the median position error
and the median angle error. The errors of a real arm without its joint zeros fall by 2 at most when
the sign of a joint is chosen wrongly for the right one."""


@dataclass(frozen=True)
class Suspect:
    """A mistake that would explain the errors.

    Attributes:
        what: what seems to be wrong, in words.
        mend: what to do.
        translation, rotation: median errors with the mistake undone, m and rad (NaN for points).
        factor: that positions of the target must be multiplied by, where that is the correction.
    """

    what: str
    mend: str
    translation: float
    rotation: float
    factor: float | None = None

    def to_json(self) -> dict[str, object]:
        """As ``calibration.json`` has it."""
        made: dict[str, object] = {
            "what": self.what,
            "mend": self.mend,
            "translation_median": self.translation,
        }
        if np.isfinite(self.rotation):
            made["rotation_median"] = self.rotation
        if self.factor is not None:
            made["factor"] = self.factor
        return made
