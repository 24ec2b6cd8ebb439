"""Command ``pytest-twin excite --check``: a short motion that tells the catalogue's laws apart."""

from __future__ import annotations

import json
from dataclasses import dataclass
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
from pytest_twin.excitation.check_motion import LONGEST, check_file, choose
from pytest_twin.excitation.designs import single_joint_designs
from pytest_twin.formats.schema import load_schema

WITHOUT_SERVOS = ARM.split("<actuator>")[0] + "</mujoco>"


@dataclass(frozen=True)
class Checked:
    """A check motion of the planar arm with servos, with its twin and folder."""

    twin: Path
    out: Path
    document: dict[str, Any]


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Checked:
    folder = tmp_path_factory.mktemp("check")
    twin = write_twin(folder, approved_for_arm(duration=5.0))
    out = folder / "out"
    out.mkdir()
    return Checked(twin, out, check_file(str(twin), str(out), 1)["document"])


def effects(names: list[str]) -> set[str]:
    return {name.split("@")[0] for name in names}


def test_one_short_motion_of_all_joints_keeps_the_approved_limits(checked: Checked) -> None:
    document = checked.document
    jsonschema.validate(document, load_schema("results/excite.schema.json"))
    (motion,) = document["trajectories"]
    assert motion["name"] == "check"
    assert motion["duration"]["value"] <= 5.0
    assert set(motion["moved"]) == {"lift", "elbow"}
    assert all(margin["share"] <= 1.0 + 1e-9 for margin in motion["margins"].values())
    assert all((checked.out / name).is_file() for name in motion["files"])


def test_a_long_approved_duration_still_gives_a_motion_under_a_minute(tmp_path: Path) -> None:
    assert LONGEST < 60.0
    twin = write_twin(tmp_path, approved_for_arm(duration=300.0), WITHOUT_SERVOS)
    (tmp_path / "out").mkdir()
    document = check_file(str(twin), str(tmp_path / "out"), 1)["document"]
    (motion,) = document["trajectories"]
    assert motion["duration"]["value"] < 60.0
    assert document["check"]["signals"] == "efforts"


def test_every_law_is_told_apart_or_named(checked: Checked) -> None:
    check = checked.document["check"]
    hidden = {one["name"] for one in check["not_shown"]}
    alike = [one["names"] for one in check["not_separated"]]
    assert check["separated"] + len(alike) == check["pairs"]
    assert not hidden & {name for pair in alike for name in pair}
    # A lower gain of the servo and a lower torque constant give the same torque.
    assert ["controller_gain@lift", "torque_constant@lift"] in alike
    # Dry and viscous friction differ over the speed, a delay and a gain over the frequency.
    assert ["coulomb_friction@lift", "viscous_friction@lift"] not in alike
    assert ["command_delay@lift", "controller_gain@lift"] not in alike
    assert not effects([*hidden, *(n for pair in alike for n in pair)]) - catalogue().keys()


def test_the_check_motion_separates_more_than_a_slow_motion_of_one_joint(tmp_path: Path) -> None:
    twin = write_twin(tmp_path, approved_for_arm(duration=5.0), WITHOUT_SERVOS)
    robot = ApprovedRobot.load(twin, 1)
    terms = terms_of(robot)
    responses = responses_of(robot, terms)
    chosen = choose(robot, terms, responses)
    assert chosen.safe is not None
    slow = [
        PairOdds.of(responses.along(design.motion(1.0, 1)), 0.9)
        for design in single_joint_designs(robot.approved, robot.loads, 1)
        if design.kind == "reversals" and design.moved == ("lift",)
    ]
    assert chosen.safe[1].separated > max(one.separated for one in slow)


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
    assert odds.separated == 2


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


def test_the_command_names_the_pairs_that_stay_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_twin(tmp_path, approved_for_arm(duration=5.0), WITHOUT_SERVOS)
    out = tmp_path / "out"
    assert cli.main(["excite", str(twin), "--check", "--out", str(out), "--json", "-"]) == 1
    stdout, said = capsys.readouterr()
    document = json.loads(stdout)
    assert document == json.loads((out / "excitation.json").read_text())
    assert "pairs of effects distinguished by efforts" in said
    first = " and ".join(document["check"]["not_separated"][0]["names"])
    assert f"! not distinguished: {first}" in said
    assert first in (out / "excitation.html").read_text()
    assert (out / "abort.json").is_file()
