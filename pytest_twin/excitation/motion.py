"""Data classes of a designed motion, and its construction from moves, dwells and sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray

Role = Literal["fit", "held_out"]
_QUINTIC_SPEED, _QUINTIC_ACCELERATION = 1.875, 10.0 / math.sqrt(3.0)
"""Peak speed and acceleration of 10 s^3 - 15 s^4 + 6 s^5 over unit distance in unit time."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Commands of the approved joints over time, in the model's sign and zero.

    Attributes:
        mechanisms: mechanisms that it identifies.
        kind: ``steps``, ``chirp``, ``reversals``, ``grid``, ``fourier`` or ``moves``.
        role: ``fit`` or ``held_out``.
        seed: seed of its random choices.
        moved: joints that it identifies; others hold a pose.
        time: (n,) time from 0, s.
        position, velocity, acceleration: (n, j) rad or m and their derivatives.
        payload: id under ``payloads:`` of ``twin.yaml``, or None.
        scale: safe share of the designed amplitude.
        settings: description for the report.
    """

    name: str
    mechanisms: tuple[str, ...]
    kind: str
    role: Role
    seed: int
    moved: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    payload: str | None = None
    scale: float = 1.0
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Design:
    """A motion that has not been checked for safety.

    Attributes:
        name, mechanisms, kind, role, moved, payload: as of :class:`Motion`.
        make: function of a share of the amplitude (0 to 1) and a seed that returns time and
            states. At share 0 the robot stays at its start.
        seed: first seed.
    """

    name: str
    mechanisms: tuple[str, ...]
    kind: str
    role: Role
    moved: tuple[str, ...]
    make: Callable[[float, int], JointStates]
    seed: int
    payload: str | None = None

    def motion(self, scale: float, seed: int) -> Motion:
        """Return the motion at a share of its amplitude."""
        states = self.make(scale, seed)
        return Motion(
            name=self.name,
            mechanisms=self.mechanisms,
            kind=self.kind,
            role=self.role,
            seed=seed,
            moved=self.moved,
            time=states.time,
            position=states.position,
            velocity=states.velocity,
            acceleration=states.acceleration,
            payload=self.payload,
            scale=scale,
            settings=states.settings,
        )


@dataclass(frozen=True, slots=True)
class JointStates:
    """States of the joints over time.

    Attributes:
        time: (n,) time from 0, s.
        position, velocity, acceleration: (n, j) rad or m and their derivatives.
        settings: description for the report.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    settings: Mapping[str, Any] = field(default_factory=dict)

    def described(self, **settings: Any) -> JointStates:
        """Return a copy with settings."""
        return replace(self, settings=settings)


class Path:
    """States built from segments that begin and end at rest.

    Args:
        start: (j,) start position, rad or m.
        speed, acceleration: (j,) largest speed and acceleration.
        rate: sample rate, Hz.
    """

    def __init__(
        self, start: FloatArray, speed: FloatArray, acceleration: FloatArray, rate: float
    ) -> None:
        self._speed, self._acceleration, self._rate = speed, acceleration, rate
        self._at = np.array(start, dtype=np.float64)
        rest = np.zeros_like(self._at)
        self._pieces: list[tuple[FloatArray, FloatArray, FloatArray]] = [
            (self._at[None].copy(), rest[None], rest[None])
        ]
        self.samples = 1

    @property
    def seconds(self) -> float:
        """Return the time from the first to the last state, s."""
        return (self.samples - 1) / self._rate

    def time_to(self, target: FloatArray) -> float:
        """Return the shortest time of a move to ``target`` (j,), in whole samples, s."""
        distance = np.abs(target - self._at)
        least = max(
            float((_QUINTIC_SPEED * distance / self._speed).max()),
            float(np.sqrt(_QUINTIC_ACCELERATION * distance / self._acceleration).max()),
        )
        return math.ceil(least * self._rate - 1e-9) / self._rate

    def move(self, target: FloatArray, share: float = 1.0) -> None:
        """Append a quintic move of all joints to ``target`` (j,), from rest to rest.

        Args:
            share: its speed as a share of the fastest move.
        """
        seconds = math.ceil(self.time_to(target) / share * self._rate - 1e-9) / self._rate
        count = round(seconds * self._rate)
        if count == 0:
            return
        s = np.arange(1, count + 1)[:, None] / count
        distance = (target - self._at)[None]
        self._add(
            self._at + distance * (10 * s**3 - 15 * s**4 + 6 * s**5),
            distance * (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds,
            distance * (60 * s - 180 * s**2 + 120 * s**3) / seconds**2,
        )

    def dwell(self, seconds: float) -> None:
        """Append a rest of at least ``seconds``."""
        count = math.ceil(seconds * self._rate - 1e-9)
        still = np.zeros((count, len(self._at)))
        self._add(np.tile(self._at, (count, 1)), still, still)

    def sweep(self, joint: int, speeds: Sequence[tuple[float, float]]) -> None:
        """Append motion of one joint at successive constant speeds, ending at rest.

        Args:
            speeds: (speed in rad/s or m/s, time in s at this speed including half of both blends).
        """
        knots = [(0.0, 0.0)]
        now, last = 0.0, 0.0
        blends: list[tuple[float, float, float, float]] = []
        for speed, seconds in (*speeds, (0.0, 0.0)):
            # The steepest slope of a raised cosine is pi/2 times the mean slope.
            blend = 0.5 * math.pi * abs(speed - last) / float(self._acceleration[joint])
            blends.append((now, blend, last, speed))
            now += blend + max(seconds - blend, 0.0)
            knots.append((now, speed))
            last = speed
        count = math.ceil(now * self._rate - 1e-9)
        time = np.arange(1, count + 1) / self._rate
        x, v, a = (np.zeros(count) for _ in range(3))
        place = 0.0
        for at, (begin, blend, before, after) in enumerate(blends):
            end = blends[at + 1][0] if at + 1 < len(blends) else max(now, count / self._rate)
            inside = (time > begin) & (time <= end + 1e-12)
            own = time[inside] - begin
            x[inside], v[inside], a[inside] = _blend(own, blend, before, after)
            x[inside] += place
            place += float(_blend(np.array([end - begin]), blend, before, after)[0][0])
        states = [np.zeros((count, len(self._at))) for _ in range(3)]
        states[0][:] = self._at
        states[0][:, joint] += x
        states[1][:, joint], states[2][:, joint] = v, a
        self._add(*states)

    def repeat(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, times: int
    ) -> None:
        """Append (n, j) states of a period several times; it begins and ends here at rest.

        The first state equals the present one, and the end of the last period is omitted.
        """
        for part in range(times):
            first = 1 if part == 0 else 0
            self._add(position[first:], velocity[first:], acceleration[first:])
        rest = np.zeros((1, position.shape[1]))
        self._add(position[:1], rest, rest)

    def states(self) -> JointStates:
        """All states so far."""
        position, velocity, acceleration = (
            np.concatenate([piece[i] for piece in self._pieces]) for i in range(3)
        )
        time = np.arange(len(position)) / self._rate
        return JointStates(time, position, velocity, acceleration)

    def _add(self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> None:
        if len(position):
            self._pieces.append((position, velocity, acceleration))
            self._at = position[-1].copy()
            self.samples += len(position)


def _blend(
    time: FloatArray, blend: float, before: float, after: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and acceleration while the speed changes by a raised cosine, and after."""
    if blend <= 0.0:
        return after * time, np.full_like(time, after), np.zeros_like(time)
    inside = np.minimum(time, blend)
    phase = math.pi * inside / blend
    change = after - before
    position = before * inside + change * (0.5 * inside - 0.5 * blend / math.pi * np.sin(phase))
    velocity = before + 0.5 * change * (1.0 - np.cos(phase))
    acceleration = 0.5 * math.pi * change / blend * np.sin(phase)
    beyond = np.maximum(time - blend, 0.0)
    return position + after * beyond, velocity, np.where(beyond > 0.0, 0.0, acceleration)
