"""An input mistake that would explain the errors, for reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FAR_BETTER = 1.0 / 3.0
"""An alternative is reported if it reduces both the median position error and the median angle
error below this fraction. On a real arm without calibrated joint zeros, replacing a correct joint
sign by a wrong one reduces the errors by a factor of 2 at most."""


@dataclass(frozen=True)
class InputMistake:
    """An input mistake that would explain the errors.

    Attributes:
        what: what seems to be wrong, as text.
        mend: how to correct it, as text.
        translation, rotation: median errors after the correction, m and rad (NaN for points).
        factor: factor that corrects the target's positions, if this is the correction.
    """

    what: str
    mend: str
    translation: float
    rotation: float
    factor: float | None = None

    def to_json(self) -> dict[str, object]:
        """Return the entry of ``calibration.json``."""
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
