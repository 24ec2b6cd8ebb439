"""Split observations into fitted and held-out ones."""

from __future__ import annotations

import numpy as np

from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Plan


def split(plan: Plan, observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows to fit and the rows to hold out, both ascending.

    A fraction is drawn from the observations in the order of the file, so a seed always gives the
    same split.

    Raises:
        SpecError: an id does not exist, or no observation is left to fit.
    """
    count = len(observations)
    wanted = plan.hold_out
    if wanted.ids is not None:
        place = {name: row for row, name in enumerate(observations.ids)}
        for name in wanted.ids:
            if name not in place:
                raise plan.error(
                    "hold_out.ids",
                    "no observation of this id",
                    value=name,
                    expected="ids of observations, such as " + ", ".join(observations.ids[:3]),
                )
        held = np.array(sorted({place[name] for name in wanted.ids}), dtype=int)
    else:
        number = round(wanted.fraction * count)
        held = np.sort(np.random.default_rng(wanted.seed).permutation(count)[:number])
    fitted = np.setdiff1d(np.arange(count), held)
    if len(fitted) == 0:
        raise plan.error(
            "hold_out", "every observation is held out", expected="some of them to fit"
        )
    return fitted, held
