"""Run the contact primitives in their scene, and measure the contact."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import Observation, Progress, Trace
from pytest_twin.checks.contact_scene import Scene
from pytest_twin.checks.fields import quantity, spec_error
from pytest_twin.checks.scalar_measures import sample_grid
from pytest_twin.golden import Golden
from pytest_twin.metrics import contact as metrics
from pytest_twin.metrics.pose import pose_vector

SAMPLES = 301
"""Number of samples of a trace."""
_SLIP_TRAVEL = 1e-3  # m: displacement beyond which a pair has slipped

Geoms = frozenset[int]


@dataclass(slots=True)
class _Record:
    """Contact between two sets of geoms, one entry per step."""

    scene: Scene
    geoms: tuple[Geoms, Geoms]
    touching: list[bool] = field(default_factory=list)
    normal: list[float] = field(default_factory=list)
    tangential: list[float] = field(default_factory=list)
    depth: list[float] = field(default_factory=list)
    friction: float = 0.0
    direction: FloatArray = field(default_factory=lambda: np.zeros(3))
    point: FloatArray = field(default_factory=lambda: np.zeros(3))
    onset: list[float] | None = None

    def __call__(self) -> None:
        from pytest_twin.realization import scene

        stage = self.scene
        touch = scene.pair_contact(stage.model, stage.data, *self.geoms)
        self.touching.append(touch.is_touching)
        self.normal.append(touch.normal_force)
        self.tangential.append(touch.tangential_force)
        self.depth.append(touch.depth)
        if touch.is_touching:
            self.friction = touch.friction
            if self.onset is None:
                self.onset = pose_vector(scene.body_pose(stage.data, stage.bodies[0])).tolist()
        if touch.normal_force > 0.0:
            self.direction, self.point = touch.normal, touch.point

    def columns(self) -> dict[str, tuple[str, FloatArray]]:
        """Return the series of the trace."""
        return {
            "normal_force": ("N", np.array(self.normal)),
            "tangential_force": ("N", np.array(self.tangential)),
            "penetration": ("m", np.array(self.depth)),
        }

    def values(self, time: FloatArray) -> dict[str, Any]:
        """Return the values common to all primitives: onset and rest."""
        touching = np.array(self.touching)
        first = metrics.onset(touching)
        if first is None:
            self.scene.never_touched()
        return {
            "onset_time": float(time[first]),
            "onset": self.onset,
            "penetration": metrics.at_rest(time, np.array(self.depth), touching),
            "normal_force": metrics.at_rest(time, np.array(self.normal), touching),
            "declared_friction": self.friction,
        }


def _trace(time: FloatArray, columns: Mapping[str, tuple[str, FloatArray]]) -> Trace:
    grid = sample_grid(float(time[-1]), SAMPLES)
    return Trace(
        axis=("time", "s"),
        x=grid,
        columns={name: (unit, np.interp(grid, time, v)) for name, (unit, v) in columns.items()},
    )


def _approach(golden: Golden, scene: Scene, progress: Progress) -> Observation:
    record = _Record(scene, scene.geoms)
    run = scene.run(scene.seconds("duration"), record, progress)
    return Observation(record.values(run.time), _trace(run.time, record.columns()))


def _release(golden: Golden, scene: Scene, progress: Progress) -> Observation:
    from pytest_twin.realization import scene as stage

    record = _Record(scene, scene.geoms)
    height: list[float] = []
    velocity: list[float] = []

    def observe() -> None:
        record()
        body = scene.bodies[0]
        height.append(float(scene.data.xipos[body, 2]))
        velocity.append(stage.velocity_of(scene.model, scene.data, body)[2])

    run = scene.run(scene.seconds("duration"), observe, progress)
    heights = np.array(height)
    bounce = metrics.rebound(heights, np.array(velocity), np.array(record.touching))
    values = record.values(run.time) | {
        "rebound": None if bounce is None else bounce.height,
        "restitution": None if bounce is None else bounce.restitution,
    }
    return Observation(values, _trace(run.time, record.columns() | {"height": ("m", heights)}))


def _slide(golden: Golden, scene: Scene, progress: Progress) -> Observation:
    from pytest_twin.realization import scene as stage

    given = golden.stimulus["slide"]
    most = quantity(golden, "stimulus.slide.force", given["force"], "N")
    duration = quantity(golden, "stimulus.slide.duration", given["duration"], "s")
    travel_bound = quantity(golden, "stimulus.slide.travel", given.get("travel", _SLIP_TRAVEL), "m")
    if not (most > 0.0 and 0.0 < duration <= 60.0 and travel_bound > 0.0):
        raise spec_error(
            golden,
            "stimulus.slide",
            "force, duration or travel is out of range",
            value=f"{most:g} N, {duration:g} s, {travel_bound:g} m",
            expected="each more than 0, and a duration of at most 60 s",
        )
    before = _Record(scene, scene.geoms)
    settled = scene.run(scene.seconds("duration"), before, lambda f: progress(0.5 * f))
    values = before.values(settled.time)
    normal = before.direction
    along = np.asarray(given["direction"], dtype=np.float64)
    along = along - (along @ normal) * normal
    length = float(np.linalg.norm(along))
    if not length > 1e-6:
        raise spec_error(
            golden,
            "stimulus.slide.direction",
            "has no part along the surface",
            value=given["direction"],
            expected="a direction across the contact normal " + str(normal.round(3).tolist()),
        )
    along /= length
    record = _Record(scene, scene.geoms, point=before.point)
    first, second = scene.bodies
    data = scene.data
    marks = [_local(data.xpos[b], data.xmat[b], before.point) for b in (first, second)]
    applied: list[float] = []
    travel: list[float] = []
    force = 0.0

    def push(time: float) -> None:
        nonlocal force
        force = most * min(1.0, time / duration)
        stage.push(scene.model, data, first, force * along, record.point)

    def observe() -> None:
        record()
        applied.append(force)
        ends = [
            data.xpos[b] + data.xmat[b].reshape(3, 3) @ mark
            for b, mark in zip((first, second), marks, strict=True)
        ]
        span = ends[0] - ends[1]
        travel.append(float(np.linalg.norm(span - (span @ normal) * normal)))

    run = scene.run(duration, observe, lambda f: progress(0.5 + 0.5 * f), more=push)
    series = record.columns()
    slip = metrics.slip(
        run.time,
        series["normal_force"][1],
        series["tangential_force"][1],
        np.array(applied),
        np.array(travel),
        least_travel=travel_bound,
    )
    values |= {
        "friction": None if slip is None else slip.friction,
        "slip_force": None if slip is None else slip.force,
        "slip": travel[-1],
        "declared_friction": record.friction,
    }
    time = np.concatenate((settled.time, run.time[1:]))
    still = np.zeros(settled.time.size)
    columns = {
        name: (unit, np.concatenate((series_before, series[name][1][1:])))
        for name, (unit, series_before) in before.columns().items()
    }
    columns["applied_force"] = ("N", np.concatenate((still, applied[1:])))
    columns["travel"] = ("m", np.concatenate((still, travel[1:])))
    return Observation(values, _trace(time, columns))


def _grip(golden: Golden, scene: Scene, progress: Progress) -> Observation:
    from pytest_twin.realization import scene as stage

    assert scene.object_body is not None
    held = stage.geoms_of(scene.model, stage.OBJECT, True)
    fingers = [_Record(scene, (geoms, held)) for geoms in scene.geoms]
    place: list[FloatArray] = []
    data = scene.data

    def observe() -> None:
        for finger in fingers:
            finger()
        body = scene.bodies[0]
        place.append(_local(data.xpos[body], data.xmat[body], data.xpos[scene.object_body]))

    closed = scene.run(scene.seconds("duration"), observe, lambda f: progress(0.5 * f))
    steps = closed.time.size
    stage.set_weight(scene.model, scene.object_body, True)
    hold = scene.run(scene.seconds("hold"), observe, lambda f: progress(0.5 + 0.5 * f))
    time = np.concatenate((closed.time, hold.time[1:]))
    # The last state of closing is also the first of holding.
    keep = np.delete(np.arange(len(place)), steps)
    touching = np.logical_and(*(np.array(finger.touching)[keep] for finger in fingers))
    both = metrics.onset(touching)
    if both is None:
        scene.never_touched()
    forces = [np.array(finger.normal)[keep] for finger in fingers]
    depth = np.maximum(*(np.array(finger.depth)[keep] for finger in fingers))
    rests = [metrics.at_rest(time, force, touching) for force in forces]
    slip = float(np.linalg.norm(place[-1] - place[steps]))
    values: dict[str, Any] = {
        "onset_time": float(time[both]),
        "onset": fingers[0].onset,
        "penetration": metrics.at_rest(time, depth, touching),
        "normal_force": None if None in rests else min(rest for rest in rests if rest is not None),
        "slip": None if None in rests else slip,
        "opening": stage.distance(scene.model, data, *scene.geoms)[0],
        "declared_friction": fingers[0].friction,
    }
    names = golden.target["pair"]
    moved = np.linalg.norm(np.array(place)[keep] - place[steps], axis=1)
    columns: dict[str, tuple[str, FloatArray]] = {
        f"normal_force:{name}": ("N", force) for name, force in zip(names, forces, strict=True)
    }
    columns |= {"penetration": ("m", depth), "object_displacement": ("m", moved)}
    return Observation(values, _trace(time, columns))


def _local(position: FloatArray, rotation: FloatArray, point: FloatArray) -> FloatArray:
    """Transform a (3,) world point into the frame of a body."""
    return np.asarray(rotation.reshape(3, 3).T @ (point - position))


PRIMITIVES: Mapping[str, Callable[[Golden, Scene, Progress], Observation]] = {
    "approach": _approach,
    "slide": _slide,
    "release": _release,
    "grip": _grip,
}
