"""Blind cases: coverage of effects, mechanics of the simulated plant, scoring of answers."""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.integrate import solve_ivp

pytest.importorskip("numba", reason="the plant is compiled: pip install 'pytest-twin[benchmarks]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import answers
import cases
import plant
import robots
import score


@pytest.mark.parametrize("first", [0, 137, 5000])
def test_any_two_hundred_seeds_cover_every_effect(first: int) -> None:
    planned = [cases.plan(seed) for seed in range(first, first + 200)]
    kinds = Counter(kind for kind, _ in planned)
    assert kinds == {"none": 40, "one": 100, "two": 20, "three": 20, "outside": 20}
    alone = Counter(given[0] for kind, given in planned if kind == "one")
    assert set(alone) == set(cases.EFFECTS)
    assert min(alone.values()) >= 2
    beside = {given[0] for kind, given in planned if kind in ("two", "three")}
    assert beside == set(cases.EFFECTS)


def test_seeds_are_given_as_ranges_numbers_or_a_file_of_answers(tmp_path: Path) -> None:
    assert cases.seeds("3:6") == [3, 4, 5]
    assert cases.seeds("3:5,9,20:22") == [3, 4, 9, 20, 21]
    said = tmp_path / "said.jsonl"
    runs = [{"run": {"case": f"case{seed:04d}"}, "said": None} for seed in (7, 60003)]
    said.write_text("".join(f"{json.dumps(run)}\n" for run in runs))
    assert cases.seeds(str(said)) == [7, 60003]
    with pytest.raises(ValueError, match="many"):
        cases.seeds("many")


def test_indistinguishable_effects_are_not_hidden_at_one_joint() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        robot = robots.draw(rng, int(rng.integers(1, 4)), "position")
        at = cases.hide([], 3, robot, rng).effects
        assert len(at) == 3
        for same in cases.SAME:
            joints = [j for effect in same & set(at) for j in at[effect]]
            assert len(joints) == len(set(joints))


def _frictionless(count: int) -> robots.Robot:
    """A robot without damping and friction."""
    robot = robots.draw(np.random.default_rng(5), count, "effort", hinges=True)
    free = [replace(j, damping=0.0, friction=0.0) for j in robot.joints]
    return replace(robot, joints=tuple(free))


def test_the_plant_matches_the_equation_of_a_pendulum() -> None:
    robot = _frictionless(1)
    j = robot.joints[0]
    start, ticks = np.array([[0.7]]), 100
    motion = plant.simulate(
        robot, plant.Hidden(), np.zeros((ticks, 1, 1)), start, sent=np.zeros((ticks, 1, 1))
    )
    inertia = j.inertia[1] + j.mass * (j.center[0] ** 2 + j.center[2] ** 2) + j.armature

    def swing(_: float, y: Any) -> list[float]:
        # Moment of gravity about +y with the centre of mass in the rotated frame.
        lever = j.center[0] * np.cos(y[0]) + j.center[2] * np.sin(y[0])
        return [y[1], j.mass * 9.81 * lever / inertia]

    time = np.arange(len(motion.position)) * plant.RECORD
    exact = solve_ivp(swing, (0.0, 1.0), [0.7, 0.0], t_eval=time, rtol=1e-10, atol=1e-12)
    assert np.ptp(exact.y[0]) > 0.5
    assert motion.position[:, 0, 0] == pytest.approx(exact.y[0], abs=5e-4)


def test_the_contact_force_at_rest_balances_the_weight() -> None:
    robot = replace(_frictionless(1), mode="position")
    j = replace(robot.joints[0], damping=20.0, kp=0.0, kv=0.0)
    along = robots.link_end(robot)[2]
    contact = robots.Contact(
        normal=(-1.0, 0.0, 0.0), height=-0.5 * along - 0.02, tip=robots.link_end(robot),
        radius=0.02, stiffness=4000.0, damping=200.0, friction=0.0, creep=0.0,
    )  # fmt: skip
    robot = replace(robot, joints=(j,), contact=contact)
    ticks = 300
    still = np.full((ticks, 1, 1), 0.5)
    motion = plant.simulate(robot, plant.Hidden(), still, still[0])
    q = motion.position[-1, 0, 0]
    # Moments about the joint: weight at the centre of mass and contact force at the sphere.
    weight = j.mass * 9.81 * (j.center[0] * np.cos(q) + j.center[2] * np.sin(q))
    depth = along * np.sin(q) + 0.02 + contact.height
    assert motion.touch[-1, 0] == pytest.approx(contact.stiffness * depth, rel=1e-3)
    lever = 0.1 + along * np.cos(q) - robot.joints[0].origin[2]
    assert motion.touch[-1, 0] * lever == pytest.approx(weight, rel=1e-2)


@pytest.mark.parametrize(("drift", "last"), [(-0.02, 0.98), (0.02, 0.99)])
def test_a_logger_with_clock_drift_records_no_time_after_the_motion(
    drift: float, last: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The logger's clock is 2 % slow or fast; no reading lies after the end of the motion."""
    monkeypatch.setattr(cases, "DURATION", 1.0)
    robot, ticks = _frictionless(1), 100
    none = np.zeros((ticks, 1, 1))
    motion = plant.simulate(robot, plant.Hidden(), none, np.array([[0.7]]), sent=none)
    hidden = plant.Hidden({"clock_drift": {-1: {"drift": drift}}})
    sensors = {
        "rate": 100.0, "jitter": 0, "noise": 0.0, "count": 1e-6, "velocity": False, "effort": False,
    }  # fmt: skip
    path = tmp_path / "swing.mcap"
    rng = np.random.default_rng(0)
    cases.write(path, robot, motion.recordings(0), hidden, sensors, "fit", rng)
    with path.open("rb") as file:
        stamps = [
            m.log_time for _, channel, m in make_reader(file).iter_messages()
            if channel.topic == "/joint_states"
        ]  # fmt: skip
    ends = (max(stamps) - cases.EPOCH_NS) * 1e-9
    assert ends == pytest.approx(last, abs=0.011)
    assert ends * (1.0 - drift) < 1.0


def _case(effects: list[tuple[str, str, float]], said: list[tuple[str, str]]) -> score.Case:
    truth = {
        "case": "case0", "kind": "two", "mode": "position", "joints": ["a", "b"], "outside": None,
        "effects": [{"effect": e, "joint": j, "parameters": {"x": 1.0}, "visibility": v}
                    for e, j, v in effects],
    }  # fmt: skip
    found = [{"effect": e, "joint": j, "parameters": {"x": {"ci95": [0.9, 1.1]}}} for e, j in said]
    diagnosis = {"verdict": "explained", "findings": found, "held_out": {}, "unexplained": {}}
    return score.Case(truth, {"status": 0, "seconds": 1.0}, diagnosis)


def test_a_finding_is_correct_only_with_effect_and_joint() -> None:
    case = _case(
        [("backlash", "a", 9.0), ("payload", "b", 0.5)], [("backlash", "b"), ("payload", "b")]
    )
    assert case.largest == ("backlash", "a")
    assert list(case.visible) == [("backlash", "a")]
    assert score.f1(case.hidden, case.found) == 0.5
    assert score.confusion([case]) == {
        ("payload", "payload"): 1,
        ("backlash", "backlash, other joint"): 1,
    }
    assert list(score.intervals(case)) == [("payload", "x", True)]


def test_an_unexplained_window_is_correct_if_it_overlaps_the_external_force() -> None:
    case = _case([], [])
    case.truth["outside"] = {"joint": "a", "windows": {"r.mcap": [[1.0, 2.0]]}}
    case.said = {"verdict": "unexplained", "findings": [], "unexplained": {
        "a": {"windows": {"r.mcap": [[1.1, 2.1]]}}}}  # fmt: skip
    assert all(score.outside_right(case).values())
    case.said["unexplained"]["a"]["windows"] = {"r.mcap": [[2.3, 9.0]]}
    assert not score.outside_right(case)["window"]


def test_a_changed_truth_file_is_detected_by_its_digest(tmp_path: Path) -> None:
    truth, committed = tmp_path / "truth", tmp_path / "digests.json"
    truth.mkdir()
    (truth / "case0.json").write_text("{}")
    committed.write_text(score.json.dumps(score.truth_digests(truth)))
    assert score.checked_digests(truth, committed, ["case0"])[1]
    (truth / "case0.json").write_text('{"effects": []}')
    assert not score.checked_digests(truth, committed, ["case0"])[1]


def test_unpacked_answers_do_not_overwrite_newer_results(tmp_path: Path) -> None:
    results, file, other = tmp_path / "results", tmp_path / "answers.jsonl", tmp_path / "other"
    (results / "case1").mkdir(parents=True)
    (results / "case1.run.json").write_text('{"case": "case1", "status": 0, "seconds": 2.0}')
    (results / "case1" / "diagnosis.json").write_text('{"verdict": "explained"}')
    (results / "case2.run.json").write_text('{"case": "case2", "status": "timeout"}')
    assert answers.pack(results, file) == 2
    assert answers.unpack(file, other) == 2
    for name in ("case1.run.json", "case1/diagnosis.json", "case2.run.json"):
        assert score.json.loads((other / name).read_text()) == score.json.loads(
            (results / name).read_text()
        )
    assert not (other / "case2" / "diagnosis.json").exists()
    # A result that exists already is kept.
    (other / "case1.run.json").write_text("{}")
    assert answers.unpack(file, other) == 0
    assert (other / "case1.run.json").read_text() == "{}"


def test_an_answer_with_a_path_outside_the_folder_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "answers.jsonl"
    file.write_text('{"run": {"case": "../case1"}, "said": null}\n')
    with pytest.raises(ValueError, match=r"answers\.jsonl: case '\.\./case1', expected a name"):
        answers.unpack(file, tmp_path / "results")


def test_tables_are_written_between_the_marks_of_a_page_without_case_names(tmp_path: Path) -> None:
    case = _case([("backlash", "a", 9.0)], [("payload", "b")])
    (line, _) = score.failures([case], named=False)
    assert line == (
        "- position commands, 2 joints: hidden backlash a (9 times the noise); found payload b"
    )
    assert score.failures([case], named=True)[0].startswith("- case0, position commands")
    page = tmp_path / "page.md"
    start, end = score.MARKS
    page.write_text(f"before\n{start}old\n{end}after\n")
    score.write_between_marks(page, f"{line}\n")
    assert page.read_text() == f"before\n{start}{line}\n{end}after\n"
    page.write_text("no marks\n")
    with pytest.raises(SystemExit, match="expected the lines"):
        score.write_between_marks(page, "")
