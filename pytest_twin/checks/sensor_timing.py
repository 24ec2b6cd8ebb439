"""Check the lag between two sensor streams of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import spec_error
from pytest_twin.checks.files import find_file
from pytest_twin.checks.records import twin_of
from pytest_twin.checks.schemas import NO_FIELDS, array, choice, name_field, table
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.formats.sensor_streams import Stream
    from pytest_twin.realization import Realization

_LEAST_CORRELATION = 0.5
"""Smallest correlation of two streams of one motion; they usually have 0.8 or more."""
_MOST_RIVAL = 0.95
"""Largest ratio of second-best to best correlation; above it the lag is ambiguous."""
_SAME_PEAK_S = 0.2
"""Smallest distance of a second peak of the correlation from the best one."""
_STREAM: Mapping[str, Any] = table(
    {
        "topic": name_field("Topic of the stream."),
        "joint": name_field("For joint states: the joint."),
        "quantity": choice(["speed", "effort"], "For joint states: its quantity. Default: speed."),
    },
    required=["topic"],
)


class SensorTiming(Check):
    """Lag of one sensor's stamps relative to another's, from a motion that both measure.

    ``values``: ``lag`` in s, positive if the second stream is stamped later; ``correlation`` of
    both at this lag.
    """

    kind: ClassVar[str] = "sensor_timing"
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy")
    tolerances: ClassVar[Mapping[str, str]] = {"lag": "s"}
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"lag"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "recording": name_field(
                    "MCAP file, rosbag2 folder or .db3 file. The path is relative "
                    "to the twin's folder or to one of its roots."
                ),
                "streams": array(
                    _STREAM,
                    "Two streams that measure one motion. An Imu or PoseStamped gives an angular "
                    "speed, a WrenchStamped a force, joint states the speed or effort of one "
                    "joint.",
                    count=2,
                ),
            },
            required=["recording", "streams"],
        ),
        "stimulus": NO_FIELDS,
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return the recording, because no part of the model affects a measured lag."""
        return {f"recording:{golden.target['recording']}"}

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute the lag with the highest correlation of both signals."""
        from pytest_twin.formats.sensor_streams import read_streams
        from pytest_twin.metrics.lag import best_lag

        twin = twin_of(golden, realization, "a recording's", "roots")
        path = find_file(golden, "target.recording", golden.target["recording"], twin)
        first, second = read_streams(
            path,
            [
                (one["topic"], one.get("joint"), one.get("quantity", "speed"))
                for one in golden.target["streams"]
            ],
        )
        progress(0.5)
        step = max(_period(first), _period(second)) / 2.0
        found = best_lag(_on_grid(first, step), _on_grid(second, step), _SAME_PEAK_S / step)
        if found.correlation < _LEAST_CORRELATION or found.rival > _MOST_RIVAL:
            problem = (
                "the two streams do not measure the same motion"
                if found.correlation < _LEAST_CORRELATION
                else "the motion repeats itself, so several lags fit"
            )
            raise spec_error(
                golden, "target.streams", problem,
                value=f"correlation {found.correlation:.2f}, of another lag "
                f"{found.rival * found.correlation:.2f}",
                expected="two sensors that measure the same irregular motion",
            )  # fmt: skip
        lag = -(found.steps * step + first.time[0] - second.time[0])
        progress(1.0)
        return Observation({"lag": float(lag), "correlation": found.correlation})

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare the lag with the recorded one, or with zero without a record."""
        lag = float(observation.values["lag"])
        then = 0.0 if golden.expected is None else float(golden.expected["lag"])
        names = " after ".join(one["topic"] for one in reversed(golden.target["streams"]))
        bound = golden.tolerance["lag"]
        return [Measure.of_difference("lag", names, (lag, then), bound)]

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing, because the robot does not determine the streams of a recording."""
        raise NothingToProposeError(
            "it needs a recording of two sensors; docs/kinds/sensor_timing.md has an example"
        )


def _period(stream: Stream) -> float:
    return float(np.median(np.diff(stream.time)))


def _on_grid(stream: Stream, step: float) -> Any:
    grid = np.arange(stream.time[0], stream.time[-1], step)
    return np.interp(grid, stream.time, stream.values)
