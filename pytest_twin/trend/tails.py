"""How heavy the tails of the scatter between sessions are, estimated from all series of a robot.

One series of a few sessions does not show its tails; all series together do. The statistic is the
kurtosis of a series, and of these the median, so that a change in some of the series counts little.
It is compared with that of Student's t laws for the same number of sessions (method of simulated
moments; the t law as a model of heavy tails: Lange, Little, Taylor, JASA 84, 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from pytest_twin.arrays import FloatArray

NORMAL = np.inf
"""Degrees of freedom of the normal law."""
_LAWS = (NORMAL, 12.0, 8.0, 6.0, 5.0, 4.0, 3.0)
"""Degrees of freedom that are compared."""
_DRAWS = 20_000
"""Simulated series for each law: the median of their kurtosis is known to 0.01."""
_FEWEST_SERIES = 6
"""Fewest series whose median counts; below, the normal law is taken."""


def tails_of(series: Sequence[FloatArray]) -> float:
    """Degrees of freedom of the t law whose kurtosis is closest to that of the series.

    Args:
        series: values of each, without what is declared; those with fewer sessions than the
            longest do not count.
    """
    longest = max((len(value) for value in series), default=0)
    of_series = np.array([value for value in series if len(value) == longest])
    if len(of_series) < _FEWEST_SERIES:
        return NORMAL
    seen = float(np.median(_kurtosis(of_series)))
    return min(_LAWS, key=lambda law: abs(_expected(longest, law) - seen))


def drawn(random: np.random.Generator, law: float, shape: tuple[int, ...]) -> FloatArray:
    """Independent values of a t law, or of the normal law."""
    return random.standard_normal(shape) if np.isinf(law) else random.standard_t(law, shape)


@lru_cache(maxsize=256)
def _expected(count: int, law: float) -> float:
    """Median kurtosis of series of some sessions."""
    return float(np.median(_kurtosis(drawn(np.random.default_rng(0), law, (_DRAWS, count)))))


def _kurtosis(series: FloatArray) -> FloatArray:
    deviation = series - series.mean(axis=1, keepdims=True)
    square = np.maximum((deviation**2).mean(axis=1), 1e-300)
    kurtosis: FloatArray = (deviation**4).mean(axis=1) / square**2
    return kurtosis
