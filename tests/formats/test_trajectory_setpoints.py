"""Setpoints of trajectories, against splines of scipy and the rules of the controller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import ros_messages as ros
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_files import START, Message, cdr
from scipy.interpolate import BPoly, CubicHermiteSpline
from test_message_types import MS, bag, read

from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.trajectory_course import TooManySetpointsError
from pytest_twin.formats.trajectory_setpoints import TrajectoryMessage, play
from pytest_twin.trial import make_trial

FIRST = 0.4


@dataclass(frozen=True)
class Reference:
    """The same rules without an incremental algorithm: every question is answered from scratch."""

    messages: list[TrajectoryMessage]

    def at(self, time: int, column: int, before: int | None = None) -> np.ndarray:
        """Position, velocity and acceleration by the first ``before`` messages."""
        count = len(self.messages) if before is None else before
        active = [k for k in range(count) if self.messages[k].start <= time]
        if not active:
            return np.array([FIRST, 0.0, 0.0])
        message = self.messages[active[-1]]
        knots = [(message.start + a, *self._point(message, k, column))
                 for k, a in enumerate(message.after.tolist())]  # fmt: skip
        if knots[0][0] > message.start:
            approach = self.at(message.start, column, active[-1])
            knots.insert(0, (message.start, *approach))
        times = [knot[0] for knot in knots]
        if time >= times[-1]:
            return np.nan_to_num(np.array(knots[-1][1:]))
        k = int(np.searchsorted(times, time, side="right")) - 1
        span = (np.array(times[k : k + 2]) - times[k]) * 1e-9
        since = (time - times[k]) * 1e-9
        (_, *one), (_, *two) = knots[k], knots[k + 1]
        if np.isnan([one[1], two[1]]).any():
            slope = (two[0] - one[0]) / span[1]
            return np.array([one[0] + slope * since, slope, 0.0])
        if np.isnan([one[2], two[2]]).any():
            spline = CubicHermiteSpline(span, [one[0], two[0]], [one[1], two[1]])
        else:
            spline = BPoly.from_derivatives(span, [one, two])
        return np.array([spline(since), spline(since, 1), spline(since, 2)])

    @staticmethod
    def _point(message: TrajectoryMessage, k: int, column: int) -> list[float]:
        velocity = message.values["velocity"]
        position = message.values["position"]
        assert position is not None
        return [
            float(position[k, column]),
            np.nan if velocity is None else float(velocity[k, column]),
            np.nan if message.acceleration is None else float(message.acceleration[k, column]),
        ]


@st.composite
def streams(draw: st.DrawFn) -> list[TrajectoryMessage]:
    found = []
    start = 0
    for _ in range(draw(st.integers(1, 6))):
        # Some begin before the one that arrived before them.
        start = max(0, start + draw(st.integers(-300, 1500)) * MS)
        steps = draw(st.lists(st.integers(1, 900), min_size=1, max_size=4))
        after = np.cumsum(steps) * MS
        if draw(st.booleans()):
            after = after - after[0]
        numbers = st.floats(-2.0, 2.0, width=16)
        tables = [
            np.array(draw(st.lists(st.tuples(numbers, numbers), min_size=len(after),
                                   max_size=len(after))))
            for _ in range(draw(st.integers(1, 3)))
        ]  # fmt: skip
        tables += [None] * (3 - len(tables))
        found.append(
            TrajectoryMessage(
                ("a", "b"),
                START + start,
                after,
                {"position": tables[0], "velocity": tables[1], "effort": None},
                tables[2],
            )
        )
    return found


@settings(max_examples=150, deadline=None)
@given(messages=streams(), at=st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5))
def test_setpoints_follow_the_splines_of_scipy(
    messages: list[TrajectoryMessage], at: list[float]
) -> None:
    played = play(messages, ("a", "b"), {"a": FIRST, "b": FIRST}, 10**7)
    assert (np.diff(played.time) > 0).all()
    reference = Reference(messages)
    first, last = int(played.time[0]), int(played.time[-1])
    for time in [first + int(share * (last - first)) for share in at]:
        for column in range(2):
            assert played.values["position"] is not None
            setpoint = np.interp(
                float(time - first), played.time - first, played.values["position"][:, column]
            )
            # At most one sample a millisecond: 5e4 rad/s^2 are the limit of these numbers.
            bend = max(abs(reference.at(t, column)[2]) for t in (time, max(first, time - MS)))
            assert setpoint == pytest.approx(reference.at(time, column)[0], abs=3e-6 + 1e-6 * bend)


def table(*rows: float) -> np.ndarray:
    return np.array(rows, float)[:, None]


def message(
    start: int, after: tuple[int, ...], position: np.ndarray | None, *names: str, **more: np.ndarray
) -> TrajectoryMessage:
    return TrajectoryMessage(
        names or ("a",),
        start * MS,
        np.array(after, np.int64) * MS,
        {"position": position, "velocity": more.get("velocity"), "effort": None},
        more.get("acceleration"),
    )


def course(messages: list[TrajectoryMessage], *names: str, **first: float) -> dict[str, list]:
    """Joint -> [(ms, setpoint)] where it has a setpoint of its own."""
    names = names or ("a",)
    played = play(messages, names, first, 10**6)
    position = played.values["position"]
    assert position is not None
    return {
        name: [
            (round(t / MS, 3), round(float(v), 6))
            for t, v in zip(played.time.tolist(), position[:, k], strict=True)
            if np.isfinite(v)
        ]
        for k, name in enumerate(names)
    }


def test_each_message_of_one_point_starts_from_the_setpoint_of_its_time() -> None:
    servo = [message(10 * k, (20,), table(1.0)) for k in range(3)]
    assert course(servo, a=0.0)["a"] == [(0, 0), (10, 0.5), (20, 0.75), (40, 1.0)]


def test_an_unknown_setpoint_before_the_first_point_is_taken_as_this_point() -> None:
    servo = [message(10 * k, (20,), table(1.0 + k)) for k in range(3)]
    assert course(servo)["a"] == [(0, 1), (10, 1), (20, 1.5), (40, 3)]
    assert play(servo, ("a",), {}, 1000).from_unknown == 1


def test_a_message_without_points_holds_the_setpoint() -> None:
    moving = message(0, (100,), table(1.0))
    stop = TrajectoryMessage((), 50 * MS, np.zeros(0, np.int64), dict.fromkeys(
        ("position", "velocity", "effort")))  # fmt: skip
    assert course([moving, stop], a=0.0)["a"] == [(0, 0), (50, 0.5)]


def test_joints_that_a_message_leaves_out_finish_their_trajectory() -> None:
    both = message(0, (100,), np.array([[1.0, 2.0]]), "a", "b")
    one = message(50, (50,), table(0.0), "a")
    assert course([both, one], "a", "b", a=0.0, b=0.0) == {
        "a": [(0, 0), (50, 0.5), (100, 0)],
        "b": [(0, 0), (100, 2)],
    }
    assert play([both, one], ("a", "b"), {}, 1000).overtaken == 1


def test_a_trajectory_that_starts_later_lets_the_earlier_one_go_on_until_then() -> None:
    early = message(0, (0, 100), table(0.0, 1.0))
    later = message(60, (40,), table(0.0))
    assert course([early, later])["a"] == [(0, 0), (60, 0.6), (100, 0)]


def test_a_later_message_cancels_a_trajectory_that_has_not_started() -> None:
    planned = message(200, (100,), table(5.0))
    now = message(0, (100,), table(1.0))
    assert course([planned, now], a=0.0)["a"] == [(0, 0), (100, 1)]


def test_a_first_point_at_time_zero_is_a_step() -> None:
    steps = [message(0, (0,), table(1.0)), message(50, (0,), table(2.0))]
    played = play(steps, ("a",), {}, 100)
    assert played.time.tolist() == [0, 50 * MS - 1, 50 * MS]
    assert played.values["position"] is not None
    assert played.values["position"][:, 0].tolist() == [1, 1, 2]


def test_curves_that_need_too_many_samples_are_refused() -> None:
    endless = message(0, (0, 10**11), table(0.0, 1e9), velocity=table(0.0, 0.0))
    with pytest.raises(TooManySetpointsError):
        play([endless], ("a",), {}, 10**6)


# -- recordings ---------------------------------------------------------------------------


def recorded(
    folder: Path, *trajectories: tuple[int, bytes], moved: float = 0.0, clock: int = START
) -> Recording:
    """States each 10 ms from 0.2 rad, and trajectories with the ms of their receipt.

    Args:
        moved: rad in 10 ms.
        clock: first stamp of the states, ns; the recorder begins at ``START``.
    """
    states = [
        (
            "/s",
            ros.JOINT_STATE,
            START + k * 10 * MS,
            cdr(Message(clock + k * 10 * MS, ("a",), (0.2 + moved * k,), ())),
        )
        for k in range(100)
    ]
    sent = [("/t", ros.TRAJECTORY, START + at * MS, data) for at, data in trajectories]
    return read(folder, bag(sorted([*states, *sent], key=lambda m: m[2])), state="/s", command="/t")


def one_point(stamp: int, position: float, after: int) -> bytes:
    return ros.trajectory(stamp, ("a",), [ros.point([position], after=after * MS)])


def test_the_first_trajectory_begins_at_the_first_state(tmp_path: Path) -> None:
    found = recorded(tmp_path, (300, one_point(0, 1.0, 100)))
    command = found.series["command"]
    assert ((command.stamp - START) // MS).tolist() == [300, 400]
    np.testing.assert_allclose(command.position, [[0.2], [1.0]])
    assert any("begins at the position of the first state" in note for note in found.notes)
    assert not any("moved" in note for note in found.notes)


def test_a_joint_that_moved_before_the_first_trajectory_is_said(tmp_path: Path) -> None:
    found = recorded(tmp_path, (300, one_point(0, 1.0, 100)), moved=0.01)
    assert any("but a moved by 0.3 rad or m before it" in note for note in found.notes)


@pytest.mark.parametrize("at", [0, 300])
def test_motion_before_a_trajectory_is_found_by_the_recorders_clock(
    tmp_path: Path, at: int
) -> None:
    """States of a simulation, whose time begins at 12 s, under trajectories without stamps."""
    clock = 12_000 * MS
    found = recorded(tmp_path, (at, one_point(0, 1.0, 100)), moved=0.01, clock=clock)
    assert any("moved by" in note for note in found.notes) is (at > 0)


def test_a_trajectory_that_arrives_long_after_its_stamp_is_said(tmp_path: Path) -> None:
    found = recorded(tmp_path, (700, one_point(START + 300 * MS, 1.0, 100)))
    assert any(
        "1 trajectories arrived after their header.stamp, by up to 0.4 s" in note
        for note in found.notes
    )


def test_log_times_do_not_move_with_a_start_in_the_future(tmp_path: Path) -> None:
    command = recorded(tmp_path, (100, one_point(START + 500 * MS, 1.0, 100))).series["command"]
    assert ((command.stamp - START) // MS).tolist() == [500, 600]
    assert command.log_time.tolist() == command.stamp.tolist()


def test_the_hold_after_a_curve_is_no_gap(tmp_path: Path) -> None:
    curve = [
        ros.point([0.2], [0.0]),
        ros.point([0.5], [0.0], after=200 * MS),
        ros.point([0.5], [0.0], after=900 * MS),
    ]
    found = recorded(tmp_path, (0, ros.trajectory(START, ("a",), curve)))
    assert not [mark for mark in make_trial(found).marks if mark.kind == "gap"]


def test_messages_without_points_alone_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no points: this commands a stop"):
        recorded(tmp_path, (300, ros.trajectory(0, (), [])))


def test_a_stop_is_said_and_the_joint_holds(tmp_path: Path) -> None:
    found = recorded(tmp_path, (300, one_point(0, 1.0, 100)), (350, ros.trajectory(0, (), [])))
    np.testing.assert_allclose(found.series["command"].position, [[0.2], [0.6]])
    assert any("1 trajectories without points are taken as a stop" in n for n in found.notes)
