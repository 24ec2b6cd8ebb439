"""What was commanded, held from stamp to stamp or moving between them, as steps see it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import Segment
from pytest_twin.trial.setpoint import Setpoint


class CommandsOverSteps:
    """Means of commands over steps; what was asked for without a delay is kept.

    Args:
        segments: whose commands; all of the same joints.
        timestep: s, of the steps that are asked for most.
        idle: (segments, joints) what holds where a joint is not commanded.
        least, greatest: (segments, joints) commands that drives heed. In a step in which a command
            changes they give the mean of what they heed, not what they heed of the mean.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        timestep: float,
        idle: FloatArray,
        least: FloatArray,
        greatest: FloatArray,
    ) -> None:
        self.segments = segments
        self.timestep = timestep
        self.idle = idle
        self.least, self.greatest = least, greatest
        self._prompt: dict[int, FloatArray] = {}
        self._held: dict[int, _Held] = {}
        # Segments that differ in the state they start from alone were commanded the same.
        first: dict[tuple[object, ...], int] = {}
        bounds = np.concatenate([idle, least, greatest], axis=1)
        self._alike = np.array([
            first.setdefault(
                (id(s.command_time), id(s.command), s.moving, s.start, of.tobytes()), i
            )
            for i, (s, of) in enumerate(zip(segments, bounds, strict=True))
        ])  # fmt: skip

    def means(
        self,
        rows: NDArray[np.int64],
        delay: FloatArray,
        steps: int,
        joints: NDArray[np.int64],
        timestep: float,
    ) -> FloatArray:
        """Mean over each step of the held command, (rows, steps, columns).

        Args:
            rows: segments; joints: (rows, columns) of them.
            delay: (rows, columns) s.
            steps: how many.
            timestep: s.
        """
        # Most rows ask for the same: each is worked out once, and what one segment's joints ask for
        # at the same time, together.
        alike = np.broadcast_to(self._alike[rows][:, None], joints.shape)
        asked = np.stack([alike, delay, joints], axis=-1)
        unlike, of = np.unique(asked.reshape(-1, 3), axis=0, return_inverse=True)
        means = np.empty((len(unlike), steps))
        firsts = np.flatnonzero(np.append(True, np.any(np.diff(unlike[:, :2], axis=0), axis=1)))
        for first, end in zip(firsts, np.append(firsts[1:], len(unlike)), strict=True):
            which = unlike[first:end, 2].astype(np.int64)
            segment, late = int(unlike[first, 0]), float(unlike[first, 1])
            means[first:end] = self._means(segment, late, steps, timestep)[which]
        return np.swapaxes(means[of.reshape(joints.shape)], 1, 2)

    def before(
        self, rows: NDArray[np.int64], joints: NDArray[np.int64], until: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """One command after the other from the first, and for how long each was held, s, 0 where it
        came too late; (rows, columns) both.

        Args:
            rows: segments; joints: (rows, columns) of them.
            until: (rows, columns) s on the clocks of their trials.
        """
        which, of = np.unique(self._alike[rows], return_inverse=True)
        held = [self._held_of(int(r)) for r in which]
        latest = [float(until[of == i].max()) for i in range(len(which))]
        counts = [int(np.searchsorted(h.far, t)) for h, t in zip(held, latest, strict=True)]
        most = max(1, *counts)
        stamps = np.full((most + 1, len(which)), np.inf)
        commands = np.empty((most, len(which), held[0].command.shape[1]))
        for i, h in enumerate(held):
            n = min(most, len(h.command))
            stamps[: n + 1, i] = h.far[: n + 1]
            commands[:n, i], commands[n:, i] = h.usual[:n], h.command[n - 1]
        row = of[:, None]
        for begun, ended, command in zip(stamps[:-1], stamps[1:], commands, strict=True):
            seconds = np.minimum(ended[row], until) - begun[row]
            yield command[row, joints], np.maximum(seconds, 0.0)

    def _means(self, segment: int, delay: float, steps: int, timestep: float) -> FloatArray:
        """(joints, steps)."""
        prompt = delay == 0.0 and timestep == self.timestep
        if prompt and segment in self._prompt and self._prompt[segment].shape[1] >= steps:
            return self._prompt[segment][:, :steps]
        s = self.segments[segment]
        at = np.asarray(s.start - delay + timestep * np.arange(steps + 1), dtype=np.float64)
        held = self._held_of(segment)
        mean = np.diff(held.sent.integral(at), axis=0).T / timestep
        if held.heeded is not None:
            change = np.diff(held.last(at)) > 0
            heeded = np.diff(held.heeded.integral(at), axis=0).T / timestep
            mean = np.where(change, heeded, mean)
        if prompt:
            self._prompt[segment] = mean
        return mean

    def _held_of(self, segment: int) -> _Held:
        if segment not in self._held:
            s = self.segments[segment]
            far = np.append(s.command_time, s.command_time[-1] + 1e6)
            command = np.where(np.isnan(s.command), self.idle[segment], s.command)
            heeded = None
            # Of a moving command drives heed what they can of the mean: a step is too short for
            # more.
            if not s.moving:
                within = np.clip(command, self.least[segment], self.greatest[segment])
                if not np.array_equal(within, command):
                    heeded = Setpoint(s.command_time, within, linear=False)
            sent = Setpoint(s.command_time, command, linear=s.moving)
            self._held[segment] = _Held(far, sent, heeded)
        return self._held[segment]


@dataclass(frozen=True, slots=True)
class _Held:
    """Commands of one segment.

    Attributes:
        far: (stamps + 1,) s.
        sent: what was commanded.
        heeded: what drives heed of it; None where that is all.
    """

    far: FloatArray
    sent: Setpoint
    heeded: Setpoint | None

    @property
    def command(self) -> FloatArray:
        """(stamps, joints) at each stamp."""
        return self.sent.value

    @property
    def usual(self) -> FloatArray:
        """(stamps, joints) mean from each stamp to the next."""
        value = self.sent.value
        if not self.sent.linear:
            return value
        return value + 0.5 * np.diff(value, axis=0, append=value[-1:])

    def last(self, at: FloatArray) -> NDArray[np.int64]:
        """The latest stamp at each time; before the first the first command holds."""
        last = np.searchsorted(self.far, at, side="right") - 1
        return np.clip(last, 0, len(self.command) - 1)
