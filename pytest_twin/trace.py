"""A trace: recorded series of a golden over one axis, such as time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Trace:
    """Series over one axis; stored next to a spec, and shown in a plot.

    Attributes:
        axis: (name, unit), such as ``("time", "s")`` or ``("frequency", "Hz")``.
        x: (n,) values of the axis, strictly increasing.
        columns: name -> (unit, (n,) values), such as ``{"position:elbow": ("rad", ...)}``.
    """

    axis: tuple[str, str]
    x: FloatArray
    columns: Mapping[str, tuple[str, FloatArray]]
