"""``diagnose --before``: what changed between two sets of recordings with measured effort."""

from __future__ import annotations

import json
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pytest_twin.changes.comparison import Comparison
from pytest_twin.changes.document import undecided_json
from pytest_twin.changes.naming import Candidate
from pytest_twin.changes.simulated_document import undecided_by_simulation
from pytest_twin.cli import main
from pytest_twin.diagnosis.not_separated import state_not_separated
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.realization import Realization
from pytest_twin.report.changes import headline, render, words

sys.path.append(str(Path(__file__).parents[1] / "identification"))
from arms import simulated_effort, true_arm, write_model, write_recording
from fourier_motion import fourier, needed_effort

pytestmark = pytest.mark.usefixtures("commands_in_process")
EARLIER = 5


def record(folder: Path, name: str, seed: int, *, factor: float = 1.0, **changes: float) -> Path:
    """A recording of 12 s of the arm, with other parameters where ``changes`` states them."""
    arm = true_arm(folder, **changes)
    time, position, effort = simulated_effort(arm, seed, seconds=12.0, rate=50.0)
    return write_recording(folder / name, time, position, factor * effort)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model that is wrong in many ways, and recordings of the arm before."""
    folder = tmp_path_factory.mktemp("robot")
    write_model(folder)
    for seed in range(EARLIER):
        record(folder, f"old{seed}.csv", seed)
    return folder


def compare(
    robot: Path, out: Path, *new: Path, old: int = EARLIER, more: tuple[str, ...] = ()
) -> tuple[int, dict[str, Any]]:
    earlier = [str(robot / f"old{k}.csv") for k in range(old)]
    status = main([
        "diagnose", str(robot / "model.xml"), *map(str, new), "--before", *earlier,
        "--out", str(out), *more,
    ])  # fmt: skip
    document = json.loads((out / "diagnosis.json").read_text()) if status < 2 else {}
    return status, document


def test_unchanged_robot_is_no_change_although_the_model_is_wrong(
    robot: Path, tmp_path: Path
) -> None:
    new = record(tmp_path, "new.csv", 11)
    status, document = compare(robot, tmp_path / "out", new)
    assert (status, document["verdict"], document["findings"]) == (0, "no_change", [])
    assert document["alarm"]["degrees_of_freedom"] == EARLIER - 1


def test_more_dry_friction_in_one_recording_is_named_with_its_size(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = record(tmp_path, "new.csv", 11, friction=1.6)
    status, document = compare(robot, tmp_path / "out", new)
    assert (status, document["verdict"]) == (1, "changed")
    (finding,) = document["findings"]
    assert (finding["effect"], finding["joint"]) == ("coulomb_friction", "shoulder")
    low, high = finding["change"]["coulomb"]["ci95"]
    assert low < 0.8 < high
    assert finding["held_out_gain"] is None
    assert document["before"]["recordings"] == [f"old{k}.csv" for k in range(EARLIER)]
    assert "nothing is held out" in capsys.readouterr().out
    assert "Changed: probably Coulomb friction at joint shoulder" in (
        (tmp_path / "out" / "report.html").read_text()
    )


@pytest.mark.parametrize(
    ("confidence", "words"),
    [(0.9, "payload"), (0.51, "probably payload"), (0.5, "could be payload")],
)
def test_the_first_line_says_how_likely_a_name_is(confidence: float, words: str) -> None:
    finding = {"effect": "payload", "joint": None, "confidence": confidence, "change": {}}
    residual = {"elbow": {"rms_usual": 1.0, "rms_after": 9.0}}
    document = {"verdict": "changed", "findings": [finding], "position": residual}
    assert headline(document) == f"Changed: {words}"


@pytest.mark.parametrize(
    ("after", "words"),
    [
        (1.2, "Nothing changed that these recordings show"),
        (2.2, "No significant change, but a larger error than before at elbow"),
    ],
)
def test_the_first_line_says_if_an_unchanged_robot_is_predicted_worse(
    after: float, words: str
) -> None:
    residual = {"elbow": {"rms_usual": 1.0, "rms_after": after}}
    document = {"verdict": "no_change", "findings": [], "position": residual}
    assert headline(document) == words


def test_held_out_recordings_test_the_change(robot: Path, tmp_path: Path) -> None:
    new = record(tmp_path, "new.csv", 11, damping=3.0)
    held_out = record(tmp_path, "held_out.csv", 12, damping=3.0)
    _, document = compare(robot, tmp_path / "out", new, more=("--held-out", str(held_out)))
    (finding,) = document["findings"]
    assert (finding["effect"], finding["joint"]) == ("viscous_friction", "shoulder")
    assert finding["held_out_gain"] > 0.9


def test_another_sampling_rate_is_no_change(robot: Path, tmp_path: Path) -> None:
    arm = true_arm(tmp_path)
    new = write_recording(tmp_path / "new.csv", *simulated_effort(arm, 11, 12.0, rate=125.0))
    assert compare(robot, tmp_path / "out", new)[0] == 0


def test_a_recording_that_is_both_before_and_new_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied = tmp_path / "renamed.csv"
    copied.write_bytes((robot / "old2.csv").read_bytes())
    status, _ = compare(robot, tmp_path / "out", copied)
    assert status == 2
    assert "the same recording is given with --before, as old2.csv" in capsys.readouterr().err


def changed_copy(of: Path, to: Path, rows: slice, decimals: int) -> Path:
    """Some rows of a recording, one hour later, with other decimals."""
    table = np.loadtxt(of, delimiter=",", skiprows=1)[rows]
    time = table[:, 0] - table[0, 0] + 3600.0
    return write_recording(to, time, *np.split(np.round(table[:, 1:], decimals), 2, axis=1))


@pytest.mark.parametrize("rows", [slice(None), slice(150, 400)], ids=["whole", "cut"])
@pytest.mark.parametrize("is_among_earlier", [False, True], ids=["new", "before"])
def test_a_changed_copy_is_no_second_recording(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rows: slice,
    is_among_earlier: bool,
) -> None:  # fmt: skip
    copied = changed_copy(robot / "old2.csv", tmp_path / "copy.csv", rows, 6)
    if not is_among_earlier:
        assert compare(robot, tmp_path / "out", copied)[0] == 2
        assert "the same recording is given with --before, as old2.csv" in capsys.readouterr().err
        return
    new = record(tmp_path, "new.csv", 11)
    _, document = compare(robot, tmp_path / "out", new, more=("--before", str(copied)))
    assert document["alarm"]["degrees_of_freedom"] == EARLIER - 1
    assert any(f"{copied}: its measured motion is that of" in note for note in document["notes"])


def test_a_held_out_copy_of_a_new_recording_proves_nothing(robot: Path, tmp_path: Path) -> None:
    new = record(tmp_path, "new.csv", 11, damping=3.0)
    copied = changed_copy(new, tmp_path / "held_out.csv", slice(0, 300), 6)
    _, document = compare(robot, tmp_path / "out", new, more=("--held-out", str(copied)))
    assert document["findings"][0]["held_out_gain"] is None


def test_a_motion_that_a_precise_machine_repeats_is_a_second_recording(
    robot: Path, tmp_path: Path
) -> None:
    """The positions are those of an earlier recording, the efforts are measured again."""
    table = np.loadtxt(robot / "old2.csv", delimiter=",", skiprows=1)
    time, position, effort = table[:, 0], table[:, 1:3], table[:, 3:]
    noise = 0.05 * np.random.default_rng(5).standard_normal(effort.shape)
    again = write_recording(tmp_path / "again.csv", time, position, effort + noise)
    assert compare(robot, tmp_path / "out", again)[0] == 0


def test_a_fleet_with_earlier_recordings_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = main([
        "diagnose", "--fleet", str(tmp_path / "fleet.yaml"), "--before", str(robot / "old0.csv"),
        "--out", str(tmp_path / "out"),
    ])  # fmt: skip
    assert status == 2
    assert "--before and --fleet cannot be combined" in capsys.readouterr().err


def test_efforts_in_another_unit_are_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = record(tmp_path, "new.csv", 11, factor=1000.0)
    status, _ = compare(robot, tmp_path / "out", new)
    assert status == 2
    assert "another unit" in capsys.readouterr().err


def test_a_recording_without_effort_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = record(tmp_path, "new.csv", 11, factor=0.0)
    status, _ = compare(robot, tmp_path / "out", new)
    assert status == 2
    assert "no measured effort" in capsys.readouterr().err


def test_a_motion_outside_the_earlier_range_raises_the_alarm_level(
    robot: Path, tmp_path: Path
) -> None:
    arm = true_arm(tmp_path)
    time, position, effort = simulated_effort(arm, 11, 12.0, rate=50.0, about=1.0)
    new = write_recording(tmp_path / "new.csv", time, position, effort)
    status, document = compare(robot, tmp_path / "out", new)
    assert any(
        "less precisely than their own: the alarm level is" in note for note in document["notes"]
    )
    assert status == 0


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Slow small motions of the arm, of a model with wrong inertia and friction."""
    folder = tmp_path_factory.mktemp("slow")
    write_model(folder)
    arm = true_arm(folder)
    for seed in range(EARLIER):
        motion_of(folder / f"old{seed}.csv", arm, seed, base=0.05, size=0.15)
    return folder


def motion_of(
    path: Path, arm: Realization, seed: int, *, base: float, size: float, ripple: float = 0.0
) -> Path:
    """Efforts along a Fourier series with a lowest frequency (Hz) and an amplitude (rad)."""
    random = np.random.default_rng(seed)
    time = np.arange(600) / 50.0
    q, v, a = fourier(random, time, 2, 5, base, (size, size))
    effort = needed_effort(arm.model, q, v, a) + 0.05 * random.standard_normal(q.shape)
    effort += ripple * np.sin(5.0 * q) * np.cos(2.0 * q[:, ::-1])
    return write_recording(path, time, q + 1e-5 * random.standard_normal(q.shape), effort)


@pytest.mark.parametrize(("friction", "status"), [(0.8, 0), (2.4, 1)])
def test_a_far_larger_and_faster_motion_is_an_alarm_only_if_the_friction_changed(
    slow: Path, tmp_path: Path, friction: float, status: int
) -> None:
    arm = true_arm(tmp_path, friction=friction)
    new = motion_of(tmp_path / "new.csv", arm, 50, base=0.1, size=0.8)
    found, document = compare(slow, tmp_path / "out", new)
    assert (found, document["verdict"] == "no_change") == (status, status == 0)
    assert document["alarm"]["threshold"] == pytest.approx(-np.log(0.05), rel=0.01)
    # Stribeck friction fits the rest of a large change with a negative friction at rest.
    names = [(finding["effect"], finding["joint"]) for finding in document["findings"]]
    assert names == [("coulomb_friction", "shoulder")] * status


def test_the_page_shows_what_is_new_beside_the_change(robot: Path, tmp_path: Path) -> None:
    new = record(tmp_path, "new.csv", 11, friction=1.6)
    _, document = compare(robot, tmp_path / "out", new)
    difference = document["findings"][0]["difference"]
    assert (difference["joint"], difference["over"]) == ("shoulder", "velocity")
    measured, change = (np.array(difference[name]) for name in ("measured", "change"))
    assert np.std(measured - change) < 0.2 * np.std(measured)
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'alt="new minus earlier effort of Coulomb friction at joint shoulder"' in page
    assert "as before" in page


def test_what_no_law_describes_has_no_sure_name_where_only_a_far_motion_shows_it(
    tmp_path: Path,
) -> None:
    """A ripple of both angles, in all recordings."""
    write_model(tmp_path)
    arm = true_arm(tmp_path)
    for seed in range(EARLIER):
        motion_of(tmp_path / f"old{seed}.csv", arm, seed, base=0.05, size=0.15, ripple=0.5)
    new = motion_of(tmp_path / "new.csv", arm, 50, base=0.1, size=0.8, ripple=0.5)
    _, document = compare(tmp_path, tmp_path / "out", new)
    assert all(finding["confidence"] < 0.9 for finding in document["findings"])


@pytest.mark.parametrize("size", [0.3, 1.0])
def test_a_change_that_no_law_describes_is_an_alarm_without_a_name(
    robot: Path, tmp_path: Path, size: float
) -> None:
    arm = true_arm(tmp_path)
    time, position, effort = simulated_effort(arm, 21, seconds=12.0, rate=50.0)
    effort += size * np.sin(12.0 * position) * np.cos(9.0 * position[:, ::-1])
    new = write_recording(tmp_path / "new.csv", time, position, effort)
    status, document = compare(robot, tmp_path / "out", new)
    assert (status, document["verdict"], document["findings"]) == (1, "changed_unnamed", [])
    assert any("what no law describes has grown at" in note for note in document["notes"])
    # What no law explains supports no law, whatever the others are worth.
    assert all(one["confidence"] < 0.5 for one in document["candidates"])


def undecided(explained: float, *candidates: Candidate) -> dict[str, Any]:
    """The part of a document that says where and what, if no change has a name."""
    comparison = SimpleNamespace(candidates=candidates, explained=explained)
    document = undecided_json(cast(Comparison, comparison), ["shoulder", "elbow"])
    residual = {"elbow": {"rms_usual": 1.0, "rms_before": 9.0, "rms_after": 9.0, "unit": "N*m"}}
    alarm = {"score": 3.0, "threshold": 1.0, "level": 0.05, "degrees_of_freedom": 4, "sessions": ""}
    return document | {
        "verdict": "changed_unnamed", "findings": [], "alarm": alarm, "effort": residual,
        "model_changes": [], "notes": [], "new": ["new.csv"], "before": {"recordings": ["old.csv"]},
    }  # fmt: skip


def candidate(effect: str, joint: int, probability: float, *others: str) -> Candidate:
    return Candidate(tuple(Term(e, joint) for e in (effect, *others)), None, probability)


def test_without_a_name_the_joint_and_the_likeliest_laws_are_said() -> None:
    document = undecided(
        1.0, candidate("coulomb_friction", 1, 0.45), candidate("coulomb_friction", 1, 0.30,
        "viscous_friction"), candidate("joint_spring", 1, 0.16), candidate("payload", -1, 0.08),
    )  # fmt: skip
    assert [one["joint"] for one in document["places"]] == ["elbow", None]
    state_not_separated(document, Path("model.xml"), Path("out"))
    first, laws, test, *_ = words(document)
    assert first == "Changed at joint elbow (91 %); the law is not decided"
    assert laws == (
        "  Likeliest laws: Coulomb friction at joint elbow (45 %), Coulomb friction at joint elbow "
        "and viscous friction at joint elbow (30 %), joint spring at joint elbow (16 %)."
    )
    assert "--separate coulomb_friction@elbow,joint_spring@elbow" in test
    assert '<td class="wrap">Joint spring at joint elbow</td>' in render(document)


def test_a_law_that_leaves_a_part_is_less_likely_but_its_joint_is_not() -> None:
    document = undecided(0.4, candidate("cogging", 0, 0.97))
    assert document["places"] == [{"joint": "shoulder", "motor": None, "confidence": 0.97}]
    assert [one["confidence"] for one in document["candidates"]] == [0.388]
    assert "  The first explains 40 % of what is new where it acts" in words(document)[2]


def test_no_joint_is_stated_that_is_less_likely_than_the_others_together() -> None:
    document = undecided(
        1.0,
        candidate("cogging", 0, 0.4),
        candidate("cogging", 1, 0.3),
        candidate("payload", -1, 0.2),
    )
    assert headline(document) == "Changed, and no single law of the catalogue explains it"
    assert len(document["candidates"]) == 3


def found_by_search(effect: str, confidence: float, *others: dict[str, Any]) -> dict[str, Any]:
    estimate = {"value": -0.1, "unit": "1", "ci95": [-0.11, -0.09]}
    return {
        "effect": effect, "joint": "elbow", "confidence": confidence, "alternatives": others,
        "change": {"scale": estimate}, "known_before": {"scale": estimate},
        "parameters": {"scale": estimate},
    }  # fmt: skip


def test_a_likelier_alternative_is_the_first_name() -> None:
    scale = {"effect": "encoder_scale", "joint": "elbow", "confidence": 0.9997}
    named = undecided(1.0) | {
        "verdict": "changed", "findings": [found_by_search("torque_constant", 0.0001, scale)],
    }  # fmt: skip
    assert headline(named) == "Changed: encoder scale at joint elbow (100 %)"
    open_ = [found_by_search("torque_constant", 0.2, scale | {"confidence": 0.6})]
    assert headline(named | {"findings": open_}) == (
        "Changed: probably encoder scale at joint elbow (60 %)"
    )
    equal = [found_by_search("torque_constant", 0.4, scale | {"confidence": 0.4})]
    assert headline(named | {"findings": equal}).startswith("Changed: could be torque constant")


def test_a_likelier_alternative_of_two_changes_is_named_once() -> None:
    other = {"effect": "viscous_friction", "joint": "elbow"}
    both = {"effect": "encoder_scale", "joint": "elbow", "confidence": 0.95, "instead_of": [other]}
    findings = [
        found_by_search("torque_constant", 0.01, both), found_by_search("viscous_friction", 0.03),
    ]  # fmt: skip
    document = undecided(1.0) | {"verdict": "changed", "findings": findings}
    assert headline(document) == (
        "Changed: encoder scale at joint elbow instead of viscous friction at joint elbow (95 %)"
    )


@pytest.mark.parametrize("is_named_by_rows", [True, False])
def test_a_law_that_no_simulation_confirms_counts_half(is_named_by_rows: bool) -> None:
    dry, viscous = Term("coulomb_friction", 0), Term("viscous_friction", 0)
    change = SimpleNamespace(
        shape=SimpleNamespace(term=dry), confidence=0.9, rivals={viscous: 0.08}
    )
    comparison = object.__new__(Comparison)
    values: dict[str, Any] = {field.name: None for field in fields(Comparison)}
    values |= {"explained": 1.0, "changes": (change,) if is_named_by_rows else ()}
    open_laws = tuple(Candidate((term,), None, p) for term, p in ((dry, 0.9), (viscous, 0.08)))
    values |= {"candidates": () if is_named_by_rows else open_laws}
    for name, value in values.items():
        object.__setattr__(comparison, name, value)
    stated = undecided_json(undecided_by_simulation(comparison, is_named=False), ["left"])
    assert stated["places"] == [{"joint": "left", "motor": None, "confidence": 0.49}]
    assert [(one["effect"], one["confidence"]) for one in stated["candidates"]] == [
        ("coulomb_friction", 0.45), ("viscous_friction", 0.04),
    ]  # fmt: skip
    named = undecided_json(undecided_by_simulation(comparison, is_named=True), ["left"])
    assert (named["places"], named["candidates"]) == ([], [])


def test_dry_and_viscous_friction_that_change_together_are_both_named(
    robot: Path, tmp_path: Path
) -> None:
    new = record(tmp_path, "new.csv", 11, friction=1.3, damping=2.4)
    _, document = compare(robot, tmp_path / "out", new)
    added = {"coulomb_friction": 0.5, "viscous_friction": 0.9}
    assert {finding["effect"] for finding in document["findings"]} == set(added)
    for finding in document["findings"]:
        assert (finding["joint"], finding["confidence"] > 0.9) == ("shoulder", True)
        (change,) = finding["change"].values()
        low, high = change["ci95"]
        assert low < added[finding["effect"]] < high


def test_nothing_is_named_at_a_joint_whose_earlier_recordings_do_not_predict_each_other(
    tmp_path: Path,
) -> None:
    """The effort of the elbow has nothing to do with its motion; then a spring is added."""
    write_model(tmp_path)
    arm = true_arm(tmp_path)
    for seed in (*range(EARLIER), 11):
        random = np.random.default_rng(seed)
        time, position, effort = simulated_effort(arm, seed, 12.0, rate=50.0)
        effort[:, 1] = fourier(random, time, 1, 5, 0.1, (0.5, 2.0))[0][:, 0]
        if seed == 11:
            effort[:, 1] += 12.0 * position[:, 1]
        write_recording(tmp_path / f"old{seed}.csv", time, position, effort)
    status, document = compare(tmp_path, tmp_path / "out", tmp_path / "old11.csv")
    assert any("do not predict each other at elbow" in note for note in document["notes"])
    assert (status, document["verdict"], document["findings"]) == (1, "changed_unnamed", [])
    assert (document["places"], document["candidates"]) == ([], [])


def test_parts_with_fewer_rows_than_laws_are_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = true_arm(tmp_path)
    short = write_recording(tmp_path / "old0.csv", *simulated_effort(arm, 3, 4.0, rate=50.0))
    status = main([
        "diagnose", str(robot / "model.xml"), str(robot / "old1.csv"), "--before", str(short),
        "--out", str(tmp_path / "out"),
    ])  # fmt: skip
    assert status == 2
    error = capsys.readouterr().err
    assert "old0.csv: 0.98 s from 0 s: too short for what is usual" in error
    assert "rows or more in each earlier recording or part" in error


def test_a_drift_between_earlier_sessions_is_no_alarm(robot: Path, tmp_path: Path) -> None:
    """The damping varies by 20 % from session to session, as with the temperature."""
    random = np.random.default_rng(3)
    write_model(tmp_path)
    for seed in range(EARLIER):
        damping = 1.5 * (1.0 + 0.2 * random.standard_normal())
        record(tmp_path, f"old{seed}.csv", seed, damping=damping)
    new = record(tmp_path, "new.csv", 11, damping=1.5 * 1.25)
    assert compare(tmp_path, tmp_path / "out", new)[0] == 0


def test_a_stricter_level_needs_a_larger_change(robot: Path, tmp_path: Path) -> None:
    new = record(tmp_path, "new.csv", 11)
    thresholds = [
        compare(robot, tmp_path / f"out{level}", new, more=("--alarm-level", level))[1]["alarm"][
            "threshold"
        ]
        for level in ("0.3", "0.05", "0.01")
    ]
    assert thresholds == sorted(thresholds)


def test_one_earlier_recording_is_compared_in_parts(robot: Path, tmp_path: Path) -> None:
    write_model(tmp_path)
    arm = true_arm(tmp_path)
    write_recording(tmp_path / "old0.csv", *simulated_effort(arm, 3, 24.0, rate=50.0))
    new = record(tmp_path, "new.csv", 11, friction=2.4)
    _, document = compare(tmp_path, tmp_path / "out", new, old=1)
    assert any("compared in parts" in note for note in document["notes"])
