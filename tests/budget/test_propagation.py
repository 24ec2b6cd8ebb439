"""Propagation of covariances to a frame, against closed forms of a planar arm and MuJoCo."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from budget_files import (
    ARM,
    FORE,
    POSES,
    UPPER,
    declared,
    fit_record,
    jacobian,
    make_twin,
    record_motion,
    with_pose,
    zeros_record,
)

from pytest_twin.budget.budget_of_twin import budget_of_file
from pytest_twin.calibration.records import inverse_with_covariance
from pytest_twin.metrics.pose import rigid

COVARIANCE = np.array([[4e-6, -1.5e-6], [-1.5e-6, 1e-6]])


def expected_rms(covariance: np.ndarray) -> float:
    squares = [np.trace(jacobian(p) @ covariance @ jacobian(p).T) for p in POSES]
    return float(np.sqrt(np.mean(squares)))


def test_errors_of_joint_zeros_agree_with_the_closed_form(tmp_path: Path) -> None:
    found = budget_of_file(str(make_twin(tmp_path, [zeros_record(COVARIANCE)], budget=declared())))
    (line,) = found["lines"]
    # The record adds 0.01 rad to each joint angle.
    moved = [{"shoulder": p["shoulder"] + 0.01, "elbow": p["elbow"] + 0.01} for p in POSES]
    squares = [np.trace(jacobian(p) @ COVARIANCE @ jacobian(p).T) for p in moved]
    assert line["linear"]["position"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)
    assert line["linear"]["worst_position"] == pytest.approx(np.sqrt(max(squares)), rel=1e-9)
    # In the plane, the rotation of the tool is the sum of both joint angles.
    assert line["linear"]["rotation"] == pytest.approx(np.sqrt(COVARIANCE.sum()), rel=1e-9)
    assert line["sampled"]["position"] == pytest.approx(line["linear"]["position"], rel=0.03)
    assert line["sampled"]["rotation"] == pytest.approx(line["linear"]["rotation"], rel=0.03)
    assert line["warnings"] == []


def test_the_correlation_of_two_joint_zeros_is_taken_into_account(tmp_path: Path) -> None:
    alone = np.diag(np.diag(COVARIANCE))
    with_it, without = (
        budget_of_file(str(make_twin(tmp_path / name, [zeros_record(c)], budget=declared())))
        for name, c in (("a", COVARIANCE), ("b", alone))
    )
    assert expected_rms(COVARIANCE) < 0.9 * expected_rms(alone)
    ratio = with_it["total"]["linear"]["position"] / without["total"]["linear"]["position"]
    assert ratio == pytest.approx(expected_rms(COVARIANCE) / expected_rms(alone), rel=0.01)


def test_for_a_large_covariance_the_sampled_error_is_exact_and_a_warning_is_given(
    tmp_path: Path,
) -> None:
    """E |R(a) p - p|^2 = 2 |p|^2 (1 - exp(-s^2 / 2)) for a normal angle a of deviation s."""
    deviation = 1.5
    record = zeros_record([[deviation**2]], ["elbow"])
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    (line,) = found["lines"]
    exact = FORE * np.sqrt(2.0 * (1.0 - np.exp(-(deviation**2) / 2.0)))
    assert line["linear"]["position"] == pytest.approx(FORE * deviation, rel=1e-9)
    assert line["sampled"]["position"] == pytest.approx(exact, rel=0.02)
    assert any("the linear rule does not hold" in text for text in line["warnings"])


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.05, 0.0, 0.12)])
def test_a_rotation_error_of_a_flange_camera_acts_with_the_distance_of_the_object(
    tmp_path: Path, place: tuple[float, float, float]
) -> None:
    """A rotation error r of the camera displaces an object at the tool by r times its distance."""
    covariance = np.diag([1e-8, 2e-8, 3e-8, 1e-6, 1e-6, 1e-6])
    record = with_pose(
        zeros_record(np.zeros((0, 0)), []), "hand_eye", ("flange", "camera"), place, covariance
    )
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    # The rotation error r has the deviation s about each axis: E |r x d|^2 = 2 s^2 |d|^2.
    expected = np.sqrt(6e-8 + 2e-6 * float(np.dot(place, place)))
    assert found["total"]["linear"]["position"] == pytest.approx(expected, rel=1e-9)
    assert found["total"]["sampled"]["position"] == pytest.approx(expected, rel=0.03)
    assert found["total"]["linear"]["rotation"] == pytest.approx(np.sqrt(3e-6), rel=1e-9)


def test_an_error_of_the_base_pose_agrees_with_the_covariance_of_the_record(tmp_path: Path) -> None:
    """The record states the base in the world, the fit the world in the base. The displacement
    of the tool must agree with the covariance that the record states."""
    fitted = np.diag([1e-8, 2e-8, 3e-8, 4e-6, 1e-6, 2e-6])
    world_in_base = rigid(np.eye(3), np.array([-0.5, 0.2, 0.1]))
    back, stated = inverse_with_covariance(world_in_base, fitted)
    record = with_pose(
        zeros_record(np.zeros((0, 0)), []), "base_world", ("world", "base"),
        back[:3, 3], fitted, stated,
    )  # fmt: skip
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    squares = []
    for pose in POSES:
        one, both = pose["shoulder"], pose["shoulder"] + pose["elbow"]
        arm = np.array(
            [
                UPPER * np.cos(one) + FORE * np.cos(both),
                UPPER * np.sin(one) + FORE * np.sin(both),
                0,
            ]
        )
        x, y, z = arm
        cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        slope = np.hstack([np.eye(3), cross])
        squares.append(np.trace(slope @ stated @ slope.T))
    assert found["total"]["linear"]["position"] == pytest.approx(
        np.sqrt(np.mean(squares)), rel=1e-9
    )
    unused = make_twin(tmp_path / "unused", [record], budget=declared(), use="[joint_zeros]")
    assert budget_of_file(str(unused))["total"]["linear"] is None


def test_fully_correlated_errors_of_joint_zero_and_fixture_cancel(tmp_path: Path) -> None:
    """The zero rotates the forearm about the elbow, and the fixture is rotated in the same way:
    the tool keeps its place in the fixture. Without correlation both errors add up."""
    pose, deviation, place = {"shoulder": 0.3, "elbow": -0.7}, 1e-3, np.array([0.5, 0.3, 0.0])
    elbow = UPPER * np.array([np.cos(0.31), np.sin(0.31), 0.0])
    turned = np.cross([0.0, 0.0, 1.0], place - elbow)
    root = deviation * np.array([1.0, *turned, 0.0, 0.0, 1.0])
    record = zeros_record([[deviation**2]], ["elbow"])
    record["records"]["joint_zeros"]["values"]["shoulder"] = {
        "value": 0.01, "unit": "rad", "ci95": [0.0, 0.02],
    }  # fmt: skip
    record = with_pose(record, "fixture", ("base", "fixture"), place, np.outer(root[1:], root[1:]))
    alone = make_twin(tmp_path / "alone", [record], budget=declared([pose]))
    record["covariance"]["matrix"] = np.outer(root, root).tolist()
    together = make_twin(tmp_path / "together", [record], budget=declared([pose]))
    sizes = [budget_of_file(str(twin))["total"]["linear"]["position"] for twin in (alone, together)]
    assert sizes[0] == pytest.approx(np.sqrt(2.0) * deviation * FORE, rel=1e-9)
    assert sizes[1] < 1e-12


def test_zeros_of_a_spatial_arm_agree_with_the_jacobian_of_mujoco(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    joints = ["yaw", "lift", "bend", "roll"]
    arm = spatial_arm(joints, rng)
    model = mujoco.MjModel.from_xml_string(arm)
    data = mujoco.MjData(model)
    factor = 1e-3 * rng.normal(size=(4, 4))
    covariance = factor @ factor.T
    poses = [dict(zip(joints, rng.uniform(-1.5, 1.5, 4).tolist(), strict=True)) for _ in range(5)]
    record = zeros_record(covariance, joints)
    squares, turns = [], []
    for pose in poses:
        for joint, value in pose.items():
            # The record adds 0.01 to each joint position.
            data.joint(joint).qpos[0] = value + 0.01
        mujoco.mj_forward(model, data)
        shift, turn = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSite(model, data, shift, turn, data.site("tool").id)
        squares.append(np.trace(shift @ covariance @ shift.T))
        turns.append(np.trace(turn @ covariance @ turn.T))
    twin = make_twin(tmp_path, [record], arm=arm, budget=declared(poses))
    found = budget_of_file(str(twin))["total"]["linear"]
    assert found["position"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)
    assert found["rotation"] == pytest.approx(np.sqrt(np.mean(turns)), rel=1e-9)


def spatial_arm(joints: list[str], rng: np.random.Generator) -> str:
    """An arm with random link poses and joint axes; one joint is a slide joint."""
    head = tail = ""
    for at, joint in enumerate(joints):
        place, turn, axis = rng.normal(size=(3, 3))
        kind = "slide" if at == 2 else "hinge"
        head += (
            f'<body name="b{at}" pos="{" ".join(map(str, 0.3 * place))}" '
            f'euler="{" ".join(map(str, 40 * turn))}">'
            f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            f'<joint name="{joint}" type="{kind}" axis="{" ".join(map(str, axis))}"/>'
        )
        tail += "</body>"
    site = '<site name="tool" pos="0.1 0.2 -0.1"/>'
    return f"<mujoco><worldbody>{head}{site}{tail}</worldbody></mujoco>"


def test_the_error_of_a_time_offset_is_the_tool_speed_times_the_deviation(tmp_path: Path) -> None:
    """The shoulder turns at 0.8 rad/s with the elbow straight: the tool moves at 0.56 m/s."""
    time = 0.01 * np.arange(200)
    position = np.column_stack([0.8 * time - 0.8, np.zeros(200)])
    deviation = 0.004
    record = zeros_record(np.zeros((0, 0)), [])
    record["records"]["time_offset"] = {
        "value": 0.02,
        "ci95": [0.02 - 1.959964 * deviation, 0.02 + 1.959964 * deviation],
    }
    budget = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
    twin = make_twin(tmp_path, [record], budget=budget)
    record_motion(tmp_path / "motion.mcap", position, np.zeros((200, 2)))
    found = budget_of_file(str(twin))
    expected = deviation * 0.8 * (UPPER + FORE)
    assert found["total"]["linear"]["position"] == pytest.approx(expected, rel=1e-3)
    assert found["total"]["sampled"]["position"] == pytest.approx(expected, rel=0.03)
    assert found["lines"][0]["category"] == "timing"
    still = make_twin(tmp_path / "still", [record], budget=declared())
    notes = budget_of_file(str(still))["notes"]
    assert any("no speed is known" in note for note in notes)


def test_correlated_errors_of_a_cameras_clock_and_its_hand_eye_pose_are_one_line(
    tmp_path: Path,
) -> None:
    """A straight arm turns at 0.8 rad/s: both errors move the seen object along the path.

    They cancel or double by the sign of their correlation. Independent ones add in squares.
    """
    deviation = 0.004
    along = deviation * 0.8 * (UPPER + FORE)
    time = 0.01 * np.arange(200)
    position = np.column_stack([0.8 * time - 0.8, np.zeros(200)])
    budget = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
    totals = {}
    for correlation in (-1.0, 0.0, 1.0):
        record = with_pose(
            zeros_record(np.zeros((0, 0)), []), "hand_eye", ("flange", "camera"), (0.0, 0.0, 0.0),
            np.diag([0.0, along**2, 0.0, 0.0, 0.0, 0.0]),
        )  # fmt: skip
        record["records"]["time_offset"] = {
            "value": 0.02,
            "ci95": [0.02 - 1.959964 * deviation, 0.02 + 1.959964 * deviation],
        }
        together = record["covariance"]
        matrix = np.zeros((7, 7))
        matrix[:6, :6] = together["matrix"]
        matrix[6, 6] = deviation**2
        matrix[1, 6] = matrix[6, 1] = correlation * along * deviation
        together["of"].append("time_offset")
        together["matrix"] = matrix.tolist()
        twin = make_twin(tmp_path / f"r{correlation}", [record], budget=budget)
        record_motion(twin.parent / "motion.mcap", position, np.zeros((200, 2)))
        found = budget_of_file(str(twin))
        (line,) = found["lines"]
        assert {part["category"] for part in line["parts"]} == {"frame_calibration", "timing"}
        states = {one["category"]: one["state"] for one in found["categories"]}
        assert sorted((states["timing"], states["frame_calibration"])) == [
            "counted_elsewhere", "measured",
        ]  # fmt: skip
        totals[correlation] = line["linear"]["position"]
    assert totals[0.0] == pytest.approx(np.sqrt(2.0) * along, rel=1e-3)
    assert min(totals.values()) < 0.01 * along
    assert max(totals.values()) == pytest.approx(2.0 * along, rel=1e-3)


def test_an_error_of_viscous_friction_agrees_with_the_solution_of_the_equation_of_motion(
    tmp_path: Path,
) -> None:
    """Constant effort u on a hinge, I a = u - b v: derivative of the solution by b."""
    inertia = 2 * 0.2**2 + 0.02 + 1 * 0.5**2 + 0.01
    arm = make_locked_arm()
    effort, damping, deviation = 0.4, 0.5, 0.03
    time = 0.01 * np.arange(101)

    def angle(b: float) -> np.ndarray:
        return effort / b * (time - inertia / b * (1.0 - np.exp(-b * time / inertia)))

    slope = (angle(damping + 1e-4) - angle(damping - 1e-4)) / 2e-4
    expected = deviation * np.sqrt(np.mean(slope**2))
    budget = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
    names = ["shoulder.viscous_friction"]
    record = fit_record(names, [deviation], ["N*m*s/rad"])
    del record["held_out"]["elbow"]
    twin = make_twin(tmp_path, fits=[record], budget=budget, arm=arm)
    record_motion(
        tmp_path / "motion.mcap",
        angle(damping)[:, None],
        np.full((101, 1), effort),
        ("shoulder",),
    )
    (line,) = budget_of_file(str(twin))["lines"]
    assert line["joints"]["shoulder"]["rms"] == pytest.approx(expected, rel=0.01)
    assert line["linear"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.01)
    assert line["sampled"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.05)
    assert line["warnings"] == []


@pytest.mark.parametrize("forces", [False, True])
def test_correlated_errors_of_command_delay_and_encoder_bias_cancel(
    tmp_path: Path, forces: bool
) -> None:
    """At constant speed v, a delay d acts like an encoder bias v d."""
    speed, deviation = 0.5, 0.004
    time = 0.01 * np.arange(51)
    names = ["shoulder.command_delay", "shoulder.encoder_bias"]
    units = ["s", "rad"]
    deviations = [deviation, speed * deviation]
    if forces:
        # A dynamic parameter, here without error, causes the motion to be simulated.
        names, units, deviations = (
            [*names, "shoulder.armature"],
            [*units, "kg*m^2"],
            [*deviations, 0.0],
        )
    record = fit_record(names, deviations, units)
    del record["held_out"]["elbow"]
    record["fit"] = {}
    budget = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
    sizes = []
    for correlation in (0.0, -1.0, 1.0):
        matrix = np.diag(np.square(deviations))
        matrix[0, 1] = matrix[1, 0] = correlation * deviations[0] * deviations[1]
        record["covariance"]["matrix"] = matrix.tolist()
        folder = tmp_path / str(correlation)
        twin = make_twin(folder, fits=[record], budget=budget, arm=make_locked_arm())
        record_motion(
            folder / "motion.mcap", (speed * time)[:, None], np.zeros((51, 1)), ("shoulder",),
            velocity=np.full((51, 1), speed),
        )  # fmt: skip
        (line,) = budget_of_file(str(twin))["lines"]
        assert line["sampled"]["position"] == pytest.approx(
            line["linear"]["position"], rel=0.05, abs=1e-6
        )
        sizes.append(line["linear"]["position"])
        own = deviation * speed * (UPPER + FORE)
        for part in line["parts"]:
            if forces and part["category"] in ("timing", "sensing"):
                assert part["alone"]["position"] == pytest.approx(own, rel=0.01)
    assert sizes == pytest.approx([np.sqrt(2.0) * own, 0.0, 2.0 * own], rel=0.01, abs=1e-5)


def test_without_motion_the_error_of_a_first_moment_is_reported_as_static_effort(
    tmp_path: Path,
) -> None:
    """In a vertical plane the error of the gravity torque is g cos(q) times that of the moment."""
    arm = make_locked_arm().replace('axis="0 0 1"', 'axis="0 1 0"', 1)
    record = fit_record(["shoulder.mx"], [0.02], ["kg*m"])
    del record["held_out"]["elbow"]
    poses = [{"shoulder": angle} for angle in (0.0, 0.4, 1.2)]
    twin = make_twin(tmp_path, fits=[record], budget=declared(poses), arm=arm)
    found = budget_of_file(str(twin))
    expected = 0.02 * 9.81 * np.sqrt(np.mean(np.cos([0.0, 0.4, 1.2]) ** 2))
    (line,) = found["lines"]
    assert line["effort"]["shoulder"] == {"rms": pytest.approx(expected, rel=1e-6), "unit": "N*m"}
    assert line["linear"] is None
    assert found["total"]["sampled"] is None


def make_locked_arm() -> str:
    """The arm without elbow joint: the forearm is fixed straight to the upper arm."""
    joint = '<joint name="elbow" axis="0 0 1" range="-2 2" limited="true"/>'
    assert joint in ARM
    return ARM.replace(joint, "").replace('<motor name="m2" joint="elbow"/>', "")
