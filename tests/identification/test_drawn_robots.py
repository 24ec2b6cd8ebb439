"""Properties of an identification from measured effort, on arms that nobody prepared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_robots import Link, drawn_arm, mjcf, write_log

from pytest_twin.estimation.paired_test import compare_paired
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS


def arm_with_logs(
    folder: Path, seed: int, joints: int, logs: int, stribeck: float = 0.0
) -> tuple[list[Link], list[Path]]:
    """Write ``model.xml`` with errors of its masses, and recordings of the real arm."""
    random = np.random.default_rng(seed)
    links = drawn_arm(random, joints, stribeck)
    errors = random.uniform(-0.3, 0.3, joints)
    (folder / "model.xml").write_text(mjcf(links, errors=errors))
    paths = [write_log(folder / f"log{k}.csv", links, random) for k in range(logs)]
    return links, paths


def identified(
    model: Path, fit: list[Path], held_out: Path, out: Path, **more: Any
) -> dict[str, Any]:
    out.mkdir()
    return identify_files({
        "model": str(model), "recordings": [str(one) for one in fit],
        "held_out": [str(held_out)], "out": str(out), "name": "arm", **more,
    })  # fmt: skip


def fitted(model: Path, fit: list[Path], held_out: Path) -> EffortResult:
    robot = load(model)
    first, last = (
        tuple(
            one
            for path in paths
            for one in read_measured(path, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
        )
        for paths in (fit, [held_out])
    )
    return identify_effort(robot, MeasuredRecordings(first, last), NO_SIGNALS)


def held_out_residual(result: EffortResult) -> np.ndarray:
    """(n, joints) held-out residual of the written parameters, relative to the efforts."""
    (rows,) = result.held_out
    residual = rows.effort - rows.matrix @ result.physical.parameters
    return np.asarray(residual / np.linalg.norm(rows.effort, axis=0) * np.sqrt(len(residual)))


@pytest.mark.parametrize("seed", range(4))
def test_more_recordings_are_never_worse_by_more_than_their_standard_error(
    tmp_path: Path, seed: int
) -> None:
    _, paths = arm_with_logs(tmp_path, seed, 3, 5, stribeck=0.5)
    held_out = paths.pop()
    before: np.ndarray | None = None
    for count in range(1, len(paths) + 1):
        result = fitted(tmp_path / "model.xml", paths[:count], held_out)
        assert not any(stage.state == "rejected" for stage in result.stages)
        residual = held_out_residual(result)
        if before is not None:
            for k in range(3):
                change = compare_paired(before[:, k : k + 1], residual[:, k : k + 1], [len(before)])
                assert change.reduction >= -2.0 * change.standard_error
        before = residual


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_joints_and_recordings_changes_nothing(tmp_path: Path, seed: int) -> None:
    links, paths = arm_with_logs(tmp_path, seed, 3, 0)
    found = []
    for name, order in (("a", [0, 1, 2]), ("b", [2, 0, 1])):
        random = np.random.default_rng([seed, 1])
        paths = [
            write_log(tmp_path / f"{name}{k}.csv", links, random, order=order) for k in range(3)
        ]
        fit = paths[:2] if name == "a" else paths[1::-1]
        found.append(identified(tmp_path / "model.xml", fit, paths[2], tmp_path / name))
    first, second = found
    assert [one["state"] for one in first["stages"]] == [one["state"] for one in second["stages"]]
    assert first["parameters"].keys() == second["parameters"].keys()
    for joint, name in enumerate(first["parameters"]):
        value = second["parameters"][name]["value"]
        assert first["parameters"][name]["value"] == pytest.approx(value, rel=1e-6, abs=1e-9), joint
    for joint, error in first["held_out"].items():
        other = second["held_out"][joint]["effort_relative"]
        assert error["effort_relative"] == pytest.approx(other, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_right_angle_that_an_exporter_rounded_changes_nothing(tmp_path: Path, seed: int) -> None:
    links, paths = arm_with_logs(tmp_path, seed, 4, 3)
    errors = []
    for rounding in (0.0, 6.5e-6):
        model = tmp_path / f"model_{rounding}.xml"
        model.write_text(mjcf(links, rounding, np.full(4, 0.2)))
        result = fitted(model, paths[:2], paths[2])
        errors.append([one.relative for one in result.errors.values()])
        assert max(errors[-1]) < 0.05
    assert errors[1] == pytest.approx(errors[0], rel=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_the_written_model_has_the_reported_error(tmp_path: Path, seed: int) -> None:
    _, paths = arm_with_logs(tmp_path, seed, 3, 3, stribeck=0.3)
    first = identified(tmp_path / "model.xml", paths[:2], paths[2], tmp_path / "one")
    again = identified(
        tmp_path / "one/realization/model.xml", paths[:2], paths[2], tmp_path / "two"
    )
    for joint, error in first["held_out"].items():
        assert error["effort_relative"] < 0.2
        written = again["held_out"][joint]["effort_relative_nominal"]
        assert written == pytest.approx(error["effort_relative"], rel=0.01)
        assert again["held_out"][joint]["effort_relative"] < 1.05 * error["effort_relative"]


def test_true_offsets_and_frictions_are_in_the_written_model(tmp_path: Path) -> None:
    links, paths = arm_with_logs(tmp_path, 7, 3, 3)
    identified(tmp_path / "model.xml", paths[:2], paths[2], tmp_path / "out")
    written = load(tmp_path / "out/realization/model.xml")
    for k, link in enumerate(links):
        dof = written.joint_dof_index(f"joint{k + 1}")
        assert written.model.dof_damping[dof] == pytest.approx(link.viscous, rel=0.15)
        assert written.model.dof_frictionloss[dof] == pytest.approx(link.dry, rel=0.15)


def test_an_effort_that_no_parameter_predicts_is_not_accepted(tmp_path: Path) -> None:
    _, paths = arm_with_logs(tmp_path, 3, 3, 3)
    held_out = np.genfromtxt(paths[2], delimiter=",", names=True)
    columns = list(held_out.dtype.names)
    table = np.column_stack([held_out[name] for name in columns])
    at = columns.index("joint2effort") if "joint2effort" in columns else 4
    table[:, at] = np.random.default_rng(0).permutation(table[:, at])
    head = paths[2].read_text().splitlines()[0]
    np.savetxt(paths[2], table, fmt="%.9g", delimiter=",", header=head, comments="")
    document = identified(tmp_path / "model.xml", paths[:2], paths[2], tmp_path / "out")
    assert document["verdict"] != "accepted"
    assert "of its effort is not predicted" in document["held_out"]["joint2"]["rejected"]
    assert "rejected" not in document["held_out"]["joint1"]


def test_a_suspected_factor_rejects_nothing_and_a_checked_joint_has_no_fatal_suspicion(
    tmp_path: Path,
) -> None:
    links, paths = arm_with_logs(tmp_path, 3, 3, 3)
    # The drawing is far too light: the effort is many times what its bodies need.
    (tmp_path / "model.xml").write_text(mjcf(links, errors=np.full(3, -0.9)))
    document = identified(tmp_path / "model.xml", paths[:2], paths[2], tmp_path / "light")
    assert any("times what the model's bodies need" in one["what"] for one in document["suspected"])
    assert not any(one["fatal"] for one in document["suspected"])
    assert document["verdict"] == "accepted"
    # A wrong sign is fatal, until a person has checked it.
    for path in paths:
        text = path.read_text().splitlines()
        rows = [line.split(",") for line in text[1:]]
        for row in rows:
            row[4] = str(-float(row[4]))
        path.write_text("\n".join([text[0], *(",".join(row) for row in rows)]) + "\n")
    for checked in (False, True):
        twin = tmp_path / f"twin_{checked}.yaml"
        twin.write_text(
            "model: model.xml\n"
            f"signals: {{joints: {{joint2: {{checked: {str(checked).lower()}}}}}}}\n"
        )
        document = identified(twin, paths[:2], paths[2], tmp_path / f"signs_{checked}")
        of_joint = [one for one in document["suspected"] if one["what"].startswith("joint2")]
        assert of_joint
        assert any(one["fatal"] for one in of_joint) == (not checked)


def test_a_torque_sensor_on_the_links_side_is_named_by_its_negative_armature(
    tmp_path: Path,
) -> None:
    random = np.random.default_rng(11)
    links = [replace(link, armature=-0.15) for link in drawn_arm(random, 3)]
    (tmp_path / "model.xml").write_text(mjcf(links))
    paths = [write_log(tmp_path / f"log{k}.csv", links, random) for k in range(3)]
    document = identified(tmp_path / "model.xml", paths[:2], paths[2], tmp_path / "out")
    said = [one["what"] for one in document["suspected"]]
    assert any("armature (reflected rotor inertia) of 'joint" in one for one in said)
    assert not any(one["fatal"] for one in document["suspected"])
    assert document["physical"]["violations"]
