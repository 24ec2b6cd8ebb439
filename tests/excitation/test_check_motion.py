"""Command ``pytest-twin excite --check``: a short motion that tells the catalogue's laws apart."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from approved_arms import ARM, approved_for_arm, write_twin

from pytest_twin import cli
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.excitation.all_pairs import PairOdds
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.catalogue_responses import LawColumns, responses_of, terms_of
from pytest_twin.excitation.check_motion import (
    LONGEST,
    TOGETHER,
    check_file,
    choose,
    groups_of,
)
from pytest_twin.excitation.designs import single_joint_designs
from pytest_twin.formats.schema import load_schema

WITHOUT_SERVOS = ARM.split("<actuator>")[0] + "</mujoco>"
SHORT: dict[str, Any] = {"duration": 3.0, "task_band": [0.5, 2.0]}
"""Approved limits with short motions."""


@dataclass(frozen=True)
class Checked:
    """A check motion of the planar arm with servos, with its twin and folder."""

    twin: Path
    out: Path
    document: dict[str, Any]


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Checked:
    folder = tmp_path_factory.mktemp("check")
    twin = write_twin(folder, approved_for_arm(**SHORT), ARM.replace("0.002", "0.004"))
    out = folder / "out"
    out.mkdir()
    return Checked(twin, out, check_file(str(twin), str(out), 1)["document"])


def effects(names: list[str]) -> set[str]:
    return {name.split("@")[0] for name in names}


def test_short_motions_of_all_joints_keep_the_approved_limits(checked: Checked) -> None:
    document = checked.document
    jsonschema.validate(document, load_schema("results/excite.schema.json"))
    motions = document["trajectories"]
    assert motions
    for motion in motions:
        assert motion["name"].startswith("check")
        assert motion["duration"]["value"] <= SHORT["duration"]
        assert set(motion["moved"]) == {"lift", "elbow"}
        assert all(margin["share"] <= 1.0 + 1e-9 for margin in motion["margins"].values())
        assert all((checked.out / name).is_file() for name in motion["files"])


@pytest.mark.nightly
def test_a_long_approved_duration_still_gives_a_sufficient_check_under_a_minute(
    tmp_path: Path,
) -> None:
    assert LONGEST < TOGETHER < 60.0
    twin = write_twin(tmp_path, approved_for_arm(duration=300.0), WITHOUT_SERVOS)
    (tmp_path / "out").mkdir()
    document = check_file(str(twin), str(tmp_path / "out"), 1)["document"]
    assert sum(one["duration"]["value"] for one in document["trajectories"]) < 60.0
    check = document["check"]
    assert check["signals"] == "efforts"
    assert document["verdict"] == "separable"
    assert check["separated"] >= 0.95 * check["separable"]
    assert check["shown"] >= 0.95 * check["showable"]


def test_every_law_is_told_apart_or_named(checked: Checked) -> None:
    check = checked.document["check"]
    assert checked.document["verdict"] == "separable"
    hidden = {*check["not_shown"], *check["never_shown"]}
    assert check["separated"] + len(check["not_separated"]) == check["separable"]
    assert check["shown"] + len(hidden) == check["laws"]
    # A lower gain of the servo and a lower torque constant give the same torque.
    groups = [set(one) for one in check["groups"]]
    assert any({"controller_gain@lift", "torque_constant@lift"} <= one for one in groups)
    # Dry and viscous friction differ over the speed, a delay and a gain over the frequency.
    for pair in (
        {"coulomb_friction@lift", "viscous_friction@lift"},
        {"command_delay@lift", "controller_gain@lift"},
    ):
        assert not any(pair <= one for one in [*groups, *map(set, check["not_separated"])])
    named = [*hidden, *(name for group in check["groups"] for name in group)]
    assert not effects(named) - catalogue().keys()


def test_a_motion_of_one_joint_is_no_sufficient_check(tmp_path: Path) -> None:
    twin = write_twin(tmp_path, approved_for_arm(**SHORT), WITHOUT_SERVOS)
    robot = ApprovedRobot.load(twin, 1)
    terms = terms_of(robot)
    responses = responses_of(robot, terms)
    chosen = choose(robot, terms, responses)
    assert chosen.is_sufficient
    # The odds of the search hold for a safe motion only if it is the motion that was judged.
    for safe, odds in chosen.motions:
        assert odds.shown == PairOdds.of(responses.along(safe.motion), odds.needed).shown
    for design in single_joint_designs(robot.approved, robot.loads, 1):
        if design.kind == "reversals" and design.moved == ("lift",):
            odds = PairOdds.of(responses.along(design.motion(1.0, 1)), 0.9)
            alone = replace(chosen, motions=((chosen.motions[0][0], odds),))
            assert not alone.is_sufficient


def test_laws_that_act_alike_are_one_group_and_every_pair_is_in_one() -> None:
    a, b, c, d = (Term("viscous_friction", joint) for joint in range(4))
    assert groups_of([(a, b), (a, c), (b, c), (c, d)]) == [(a, b, c), (c, d)]
    assert groups_of([]) == []


def columns_of(*readings: np.ndarray) -> LawColumns:
    """Columns of laws at one joint, each with a single size and one signal."""
    terms = [Term(name, 0) for name in ("viscous_friction", "coulomb_friction", "joint_spring")]
    used = terms[: len(readings)]
    return LawColumns(
        np.array(readings)[:, :, None], {term: [i] for i, term in enumerate(used)},
        dict.fromkeys(used, 1),
    )  # fmt: skip


def test_laws_whose_readings_are_proportional_stay_alike_and_orthogonal_ones_do_not() -> None:
    time = np.linspace(0.0, 40.0 * np.pi, 2000)
    odds = PairOdds.of(columns_of(50 * np.sin(time), 80 * np.sin(time), 50 * np.cos(time)), 0.9)
    by_name = {(a.effect, b.effect): value for (a, b), value in odds.pairs.items()}
    assert by_name["viscous_friction", "coulomb_friction"] == pytest.approx(0.0, abs=0.1)
    assert by_name["viscous_friction", "joint_spring"] > 7.0
    assert len(odds.distinguished) == 2


def test_a_law_below_the_noise_is_not_shown_and_enters_no_pair() -> None:
    time = np.linspace(0.0, 40.0 * np.pi, 2000)
    odds = PairOdds.of(columns_of(0.01 * np.sin(time), 50 * np.cos(time)), 0.9)
    assert odds.shown[Term("viscous_friction", 0)] < 0.0
    assert odds.pairs == {}


def test_limits_are_never_invented(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "twin.yaml").write_text("model: arm.xml\n")
    words = ["excite", str(tmp_path / "twin.yaml"), "--check", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    out, error = capsys.readouterr()
    assert "excitation:" in out
    assert "approved_by" in error
    assert not (tmp_path / "out" / "excitation.json").exists()


def test_check_and_separate_together_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_twin(tmp_path, approved_for_arm())
    separate = ["--separate", "backlash@elbow,dead_zone@elbow"]
    words = ["excite", str(twin), "--check", *separate, "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--check" in line
    assert "--separate" in line


@pytest.mark.nightly
def test_with_servos_the_check_is_compared_with_other_motions(tmp_path: Path) -> None:
    """By efforts one motion may reach all; by positions it is not its own measure."""
    twin = write_twin(tmp_path, approved_for_arm(duration=5.0), ARM)
    out = tmp_path / "out"
    assert cli.main(["excite", str(twin), "--check", "--out", str(out)]) < 2
    check = json.loads((out / "excitation.json").read_text())["check"]
    assert (check["signals"], check["tried"]) == ("positions and efforts", 6)


def test_the_command_says_what_the_check_can_and_cannot_tell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_twin(tmp_path, approved_for_arm(**SHORT), WITHOUT_SERVOS)
    out = tmp_path / "out"
    assert cli.main(["excite", str(twin), "--check", "--out", str(out), "--json", "-"]) == 0
    stdout, said = capsys.readouterr()
    document = json.loads(stdout)
    assert document == json.loads((out / "excitation.json").read_text())
    assert "Sufficient check: " in said
    assert "compared motions shows or distinguishes by efforts" in said
    page = (out / "excitation.html").read_text()
    group = document["check"]["groups"][0]
    assert f"= act alike along every compared motion: {' = '.join(group)}" in said
    assert f"act alike: {', '.join(group)}" in page
    assert "too small to show" in said
    assert (out / "abort.json").is_file()
