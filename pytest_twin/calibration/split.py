"""Split observations into fitted and held-out ones."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pytest_twin.calibration.observations import Observations, id_order
from pytest_twin.calibration.plan import Plan


def split(
    plan: Plan, observations: Observations, left_out: Collection[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows to fit and the rows to hold out, both ascending.

    A fraction is drawn by id, so the order of the rows has no influence.

    Args:
        observations: the rows.
        left_out: ids of observations that are not used; the plan may hold them out.

    Raises:
        SpecError: an id does not exist, or no observation is left to fit.
    """
    count = len(observations)
    wanted = plan.hold_out
    if wanted.ids is not None:
        place = {name: row for row, name in enumerate(observations.ids)}
        for name in wanted.ids:
            if name not in place and name not in left_out:
                raise plan.error(
                    "hold_out.ids",
                    "no observation of this id",
                    value=name,
                    expected="ids of observations, such as " + ", ".join(observations.ids[:3]),
                )
        held = np.array(sorted({place[name] for name in wanted.ids if name in place}), dtype=int)
    else:
        number = round(wanted.fraction * count)
        by_id = np.array(sorted(range(count), key=lambda row: id_order(observations.ids[row])))
        drawn = np.random.default_rng(wanted.seed).permutation(count)[:number]
        held = np.sort(by_id[drawn]) if number else drawn
    fitted = np.setdiff1d(np.arange(count), held)
    if len(fitted) == 0:
        raise plan.error(
            "hold_out", "every observation is held out", expected="some of them to fit"
        )
    return fitted, held
