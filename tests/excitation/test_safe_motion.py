"""Every approved limit refuses a motion that exceeds it, and each motion has its frequencies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approved_arms import Excited, approved_for_arm, loaded, write_twin

from pytest_twin.excitation import single_joint
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.closed_loop import WORSE
from pytest_twin.excitation.excite import Excitation, excite
from pytest_twin.excitation.find_safe import Robot, SafeMotion
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.read_limits import read_approved
from pytest_twin.excitation.safety import check_commands, check_simulation, reasons
from pytest_twin.identification.regressor.regressor import Regressor

UPPER, LOWER = 0.25, 0.15
"""Lengths of the two links, m."""


@pytest.fixture(scope="module")
def found(excited: Excited) -> Excitation:
    return excited.found


def safe(found: Excitation, name: str) -> SafeMotion:
    return next(one for one in found.safe if one.motion.name == name)


def checked(folder: Path, motion: Motion, **changes: Any) -> list[str]:
    """Limits that the commands of a motion exceed, with changed lines under ``excitation:``."""
    realization, twin = loaded(write_twin(folder, approved_for_arm(**changes)))
    approved = read_approved(realization, twin)
    return reasons([check_commands(motion, approved, ClearanceChecker(realization, approved))])


def tip(position: np.ndarray) -> np.ndarray:
    """(n, 2) x and z of the tip by the closed form; positive angles turn downwards."""
    first, both = position[:, 0], position.sum(axis=1)
    return np.column_stack([
        UPPER * np.cos(first) + LOWER * np.cos(both),
        -UPPER * np.sin(first) - LOWER * np.sin(both),
    ])  # fmt: skip


def test_motions_of_one_joint_come_before_those_of_several(found: Excitation) -> None:
    several = [len(one.motion.moved) > 1 for one in found.safe]
    assert several == sorted(several)
    assert set(several) == {False, True}


def test_a_fourier_series_has_the_frequencies_of_the_task(found: Excitation) -> None:
    low, high = found.approved.band
    for role in ("fit", "held_out"):
        motion = safe(found, f"fourier_{role}").motion
        frequencies = np.array(motion.settings["frequencies"])
        assert len(frequencies) >= 3
        assert low - 1e-9 <= frequencies.min()
        assert frequencies.max() <= high + 1e-9
        assert power_above(motion, 1.25 * high) < 0.02


def test_a_chirp_sweeps_the_task_band_in_opposite_directions(found: Excitation) -> None:
    low, high = found.approved.band
    for role in ("fit", "held_out"):
        wave = single_joint.chirp(found.approved, 0, role)(1.0, 5).position[:, 0]  # type: ignore[arg-type]
        parts = np.array_split(wave, 4)
        first, last = (
            np.count_nonzero(np.diff(np.sign(p - wave[0]))) for p in (parts[0], parts[-1])
        )
        assert (first < last) == (role == "fit")
        spectrum = np.abs(np.fft.rfft(wave - wave.mean())) ** 2
        frequency = np.fft.rfftfreq(len(wave), 1.0 / found.approved.rate)
        inside = (frequency > 0.6 * low) & (frequency < 1.25 * high)
        assert spectrum[inside].sum() > 0.95 * spectrum.sum()


def power_above(motion: Motion, frequency: float) -> float:
    """Share of the velocity's power above a frequency, Hz."""
    rate = 1.0 / (motion.time[1] - motion.time[0])
    power = np.abs(np.fft.rfft(motion.velocity, axis=0)) ** 2
    above = np.fft.rfftfreq(len(motion.velocity), 1.0 / rate) > frequency
    return float(power[above].sum() / power.sum())


def test_reversals_are_made_at_the_least_and_at_the_greatest_load(found: Excitation) -> None:
    regressor = Regressor(found.realization, found.approved.names)
    grid = np.linspace(-1.4, 1.4, 57)
    still = np.zeros((len(grid), 2))
    loads = []
    for number in (1, 2):
        pose = np.array(safe(found, f"reversals_lift_load{number}_fit").motion.settings["pose"])
        matrix = regressor.matrix(pose[None], still[:1], still[:1])
        loads.append(float((matrix[0] @ regressor.prior)[0]))
    poses = np.column_stack([np.zeros_like(grid), grid])
    every = (regressor.matrix(poses, still, still) @ regressor.prior)[:, 0]
    assert abs(loads[1] - loads[0]) > 0.9 * np.ptp(every)


def test_effort_is_checked_for_a_model_that_is_20_percent_worse(found: Excitation) -> None:
    assert WORSE == 1.2
    one = safe(found, "fourier_fit")
    nominal, worse = (
        next(k for k in one.verdict.kept if k.what == f"effort of lift, {whose}")
        for whose in ("nominal model", "20 % worse model")
    )
    assert 1.1 * nominal.value < worse.value < 1.3 * nominal.value
    # The nominal model alone keeps this limit.
    lift = replace(found.approved.joints[0], effort=0.5 * (nominal.value / 0.95 + worse.value))
    tight = replace(found.approved, joints=(lift, found.approved.joints[1]))
    robot = Robot(found.realization, tight)
    responses = [model.responses([one.motion])[0] for model in (robot.nominal, robot.worse)]
    verdict = check_simulation(one.motion, tight, robot.around, *responses)
    assert not verdict.is_safe
    assert [words.partition(":")[0] for words in reasons([verdict])] == [
        "effort of lift, 20 % worse model"
    ]


def test_a_pair_of_links_has_its_own_distance(found: Excitation, tmp_path: Path) -> None:
    motion = safe(found, "steps_lift_fit").motion
    lowest = tip(motion.position)[:, 1].min()
    # The floor is 0.5 m below; the capsule has a radius of 0.03 m.
    distance = 0.5 + lowest - 0.03
    for required, refused in ((1.01 * distance, True), (0.9 * distance, False)):
        pair = {"links": ["lower", "floor"], "distance": float(required)}
        clearance = {"self": 0.01, "environment": 0.02, "pairs": [pair]}
        words = checked(tmp_path, motion, clearance=clearance)
        assert bool(words) == refused
        assert all(one.startswith("clearance of lower and floor: ") for one in words)


def test_a_frame_outside_its_box_is_refused(found: Excitation, tmp_path: Path) -> None:
    motion = safe(found, "grid_fit").motion
    highest = float(tip(motion.position)[:, 1].max())
    for top, refused in ((highest - 0.01, True), (highest + 0.01, False)):
        box = {"frame": "tip", "min": [-1.0, -1.0, -0.45], "max": [1.0, 1.0, top]}
        words = checked(tmp_path, motion, workspace=[box])
        assert bool(words) == refused
        assert all(one.startswith("workspace: room of tip in its box") for one in words)


def test_designed_motions_stay_in_a_small_box(tmp_path: Path) -> None:
    box = {"frame": "tip", "min": [0.2, -1.0, -0.16], "max": [1.0, 1.0, 0.1]}
    section = approved_for_arm(mechanisms=["gravity"], workspace=[box])
    small = excite(*loaded(write_twin(tmp_path, section)))
    assert small.safe
    for one in small.safe:
        for position in (one.motion.position, one.response.position):
            x, z = tip(position).T
            assert x.min() >= 0.2
            assert z.min() >= -0.16
            assert z.max() <= 0.1


def test_an_abort_at_any_time_ends_within_the_range_of_the_joint(
    found: Excitation, tmp_path: Path
) -> None:
    motion = safe(found, "fourier_fit").motion
    late = {"category": 1, "reaction": 2.0, "plan": "enabling switch"}
    assert checked(tmp_path, motion) == []
    words = checked(tmp_path, motion, stop=late)
    assert any(one.startswith("stop of ") for one in words)
    # The worst stop by hand: reaction at full speed, then braking.
    for at, joint in enumerate(found.approved.joints):
        v = motion.velocity[:, at]
        end = motion.position[:, at] + 2.0 * v + 0.5 * v * np.abs(v) / joint.acceleration
        outside = end.max() > joint.stop_upper or end.min() < joint.stop_lower
        assert outside == any(one.startswith(f"stop of {joint.name}") for one in words)


def test_a_margin_is_kept_from_every_limit(found: Excitation) -> None:
    approved: ApprovedLimits = found.approved
    for one in found.safe:
        effort = np.abs(one.response.effort).max(axis=0)
        power = np.maximum(one.response.effort * one.response.velocity, 0.0).sum(axis=1).max()
        assert np.all(effort <= 0.95 * approved.array("effort") + 1e-9), one.motion.name
        assert power <= 0.95 * approved.power
