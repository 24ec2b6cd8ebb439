"""Calibration from two pose streams with separate clocks: time offset, drift and hand-eye pose."""

import gzip
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from nightly import samples
from scipy.spatial.transform import Rotation

from pytest_twin import cli
from pytest_twin.calibration.cameras.increments import apply_change
from pytest_twin.calibration.clocks.streams import read_stream
from pytest_twin.calibration.solvers import algebraic
from pytest_twin.errors import FormatError
from pytest_twin.metrics.pose import inverse

pytestmark = pytest.mark.usefixtures("commands_in_process")

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).parents[4] / "shared" / "recordings"
)
HAND_EYE = apply_change(np.eye(4), np.array([0.05, -0.02, 0.06, 0.1, -0.2, 0.7]))
TARGET = apply_change(np.eye(4), np.array([0.6, 0.1, 0.05, 0.2, 3.0, 0.1]))


def motion(seed: int, slow: float = 1.0, burst: float | None = None):
    """Poses of a hand as a function of time: sums of sines without a common period.

    With ``burst``, the hand moves only for about ``burst`` seconds in the middle of 40 s.
    """
    rng = np.random.default_rng(seed)
    rate = slow * rng.uniform(0.5, 3.0, (6, 5))
    phase = rng.uniform(0, 2 * np.pi, (6, 5))
    size = np.array([0.05, 0.05, 0.05, 0.25, 0.25, 0.25])

    def at(time: np.ndarray) -> np.ndarray:
        waves = np.sin(time[:, None, None] * rate + phase).mean(axis=2) * size
        if burst is not None:
            waves = waves * np.exp(-(((time[:, None] - 20.0) / burst) ** 2))
        return apply_change(np.tile(np.eye(4), (len(time), 1, 1)), waves)

    return at


def write_stream(path: Path, time: np.ndarray, poses: np.ndarray, header: bool = False) -> None:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([time, poses[:, :3, 3], quaternions])
    lines = ["t,x,y,z,qx,qy,qz,qw"] if header else []
    lines += [",".join(repr(float(v)) for v in row) for row in rows]
    text = "\n".join(lines) + "\n"
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text)


def write_streams(
    folder: Path,
    *,
    offset=0.037,
    drift=0.0,
    noise=5e-4,
    seed=1,
    slow=1.0,
    inverted=False,
    other_motion=False,
    burst=None,
    sway=0.0,
    step=0.0,
    depth=1.0,
    mount="hand",
    size_tolerance=None,
) -> None:
    rng = np.random.default_rng(seed)
    hand = motion(seed, slow, burst)
    time = np.arange(0.0, 40.0, 0.01)
    poses = apply_change(hand(time), 0.2 * noise * rng.normal(size=(len(time), 6)))
    write_stream(folder / "hand.csv", time, poses, header=True)
    stamps = np.arange(2.0, 38.0, 0.04) + rng.uniform(0, 0.01, 900)
    true = stamps + offset + drift * (stamps - stamps.mean())
    seen = inverse((motion(seed + 50) if other_motion else hand)(true) @ HAND_EYE) @ TARGET
    if sway:
        # The camera mount deflects with the square of the speed, in a random direction.
        before, after = (inverse(hand(true + d) @ HAND_EYE) @ TARGET for d in (-0.01, 0.01))
        speed = np.linalg.norm((after - before)[:, :3, 3], axis=1) / 0.02
        seen[:, :3, 3] += sway * speed[:, None] ** 2 * rng.normal(size=(len(true), 3))
    if mount == "world":
        # The camera is fixed at the pose TARGET; the target is on the hand at HAND_EYE.
        seen = inverse(TARGET) @ hand(true) @ HAND_EYE
    seen = apply_change(seen, noise * rng.normal(size=(len(stamps), 6)))
    seen[:, 2, 3] *= depth
    stamps = np.where(stamps > stamps.mean(), stamps + step, stamps)
    write_stream(folder / "camera.csv.gz", stamps, inverse(seen) if inverted else seen)
    plan = {
        "calibration": "clocks",
        "streams": {"hand": "hand.csv", "camera": "camera.csv.gz"},
        "estimate": ["time_offset", "hand_eye", "robot_world"],
        "camera": {"mount": mount},
        "hold_out": {"fraction": 0.3, "seed": 1},
        "accept": {"translation": 0.002, "rotation": 0.003},
    }
    if size_tolerance is not None:
        plan["target"] = {"tolerance": size_tolerance}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))


def calibrated(folder: Path, start_poses: int = 30) -> tuple[int, dict]:
    """Calibrate; algebraic solvers, whose time is quadratic, start from fewer poses than 120."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algebraic, "MOST_POSES", start_poses)
        status = cli.main(["calibrate", str(folder / "plan.yaml"), "--out", str(folder / "out")])
    return status, json.loads((folder / "out" / "calibration.json").read_text())


def averaged(poses: np.ndarray, count: int) -> np.ndarray:
    """Means of ``count`` successive poses."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    signs = np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    quaternions[1:] *= np.cumprod(signs)[:, None]
    rows = np.pad(np.hstack([poses[:, :3, 3], quaternions]), ((count // 2,) * 2, (0, 0)), "edge")
    means = np.stack([np.convolve(row, np.ones(count) / count, "valid") for row in rows.T], axis=1)
    found = poses.copy()
    found[:, :3, 3] = means[:, :3]
    found[:, :3, :3] = Rotation.from_quat(means[:, 3:]).as_matrix()
    return found


@pytest.mark.parametrize(("stream", "count"), [("camera.csv.gz", 5), ("hand.csv", 21)])
def test_a_stream_that_was_averaged_over_time_is_rejected(tmp_path, stream, count):
    write_streams(tmp_path)
    path = tmp_path / stream
    read = read_stream(path)
    write_stream(path, read.time, averaged(read.poses, count), header=stream == "hand.csv")
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"]) == (1, "rejected")
    (reason,) = found["reasons"]
    period = float(np.median(np.diff(read.time)))
    assert reason.startswith(f"the {stream.partition('.')[0]}'s poses are smoother than")
    width = float(re.search(r"standard deviation (\d+) ms", reason)[1])
    assert width == pytest.approx(1e3 * period * np.sqrt((count**2 - 1) / 12), rel=0.2)


def test_what_no_residual_shows_is_a_condition_of_each_record(tmp_path, capsys):
    write_streams(tmp_path)
    _, found = calibrated(tmp_path)
    delay = "no filter delays one stream more than the other"
    assert found["verdict"] == "accepted"
    for record in found["records"].values():
        assert any(condition.startswith(delay) for condition in record["holds_if"])
    out = capsys.readouterr().out
    assert out.startswith("Accepted on condition: clocks")
    assert f"  if {delay}" in out
    assert f"on condition that {delay}" in (tmp_path / "out" / "calibration.html").read_text()


@pytest.mark.parametrize("inverted", [False, True])
def test_time_offset_and_hand_eye_pose_are_estimated_with_valid_intervals(tmp_path, inverted):
    write_streams(tmp_path, inverted=inverted)
    status, found = calibrated(tmp_path)
    assert status == 0
    offset = found["records"]["time_offset"]
    width = offset["ci95"][1] - offset["value"]
    assert abs(offset["value"] - 0.037) < 2.0 * width
    assert width < 2e-3
    assert offset["correlation"] > 0.9
    record = found["records"]["hand_eye"]
    off = np.array(record["transform"]["xyz"]) - HAND_EYE[:3, 3]
    assert (np.abs(off) < 4.0 * np.sqrt(np.diag(record["covariance"]))[:3]).all()
    assert any("camera's stream was inverted" in note for note in found["notes"]) == inverted
    together = np.array(found["covariance"]["matrix"])
    assert found["covariance"]["of"][0] == "time_offset"
    assert width == pytest.approx(2.0 * np.sqrt(together[0, 0]), rel=0.15)
    np.testing.assert_allclose(together[1:7, 1:7], record["covariance"], rtol=1e-12)
    other = found["records"]["robot_world"]["covariance"]
    np.testing.assert_allclose(together[7:13, 7:13], other, rtol=1e-12)
    assert np.linalg.eigvalsh(together).min() > 0.0


@pytest.mark.parametrize("inverted", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_errors_with_a_fixed_camera_are_computed_at_the_target(tmp_path, inverted):
    # At the camera, 0.6 m away, angular errors would increase the 2 mm by a tenth.
    write_streams(tmp_path, mount="world", noise=2e-3, inverted=inverted)
    _, found = calibrated(tmp_path)
    assert found["held_out"]["translation_rms"] == pytest.approx(2.04e-3, rel=0.04)
    for name, truth, row in (("target", HAND_EYE, 1), ("robot_world", TARGET, 7)):
        record = found["records"][name]
        off = np.array(record["transform"]["xyz"]) - truth[:3, 3]
        assert (np.abs(off) < 4.0 * np.sqrt(np.diag(record["covariance"]))[:3]).all()
        together = np.array(found["covariance"]["matrix"])[row : row + 6, row : row + 6]
        np.testing.assert_allclose(together, record["covariance"], rtol=1e-12)


@pytest.mark.parametrize("mount", ["hand", "world"])
def test_the_page_shows_errors_in_the_base_frame_and_both_streams_on_one_clock(tmp_path, mount):
    write_streams(tmp_path, mount=mount, offset=0.5, size_tolerance=0.0)
    _, found = calibrated(tmp_path)
    speeds = found["angular_speeds"]
    assert np.corrcoef(speeds["hand"], speeds["camera"])[0, 1] > 0.99
    scene = found["scene"]
    standing = scene["frames"][3]
    assert standing["name"] == {"hand": "target", "world": "camera"}[mount]
    np.testing.assert_allclose(standing["xyz"], TARGET[:3, 3], atol=1e-3)
    np.testing.assert_allclose(np.transpose(standing["axes"]), TARGET[:3, :3], atol=2e-3)
    errors = [one["error"] for one in scene["arrows"]]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(
        found["fitted"]["translation_rms"], rel=0.2
    )
    regions = found["held_out"]["regions"]
    assert [one["region"] for one in regions] == ["near", "middle", "far"]
    squares = [one["count"] * one["translation_rms"] ** 2 for one in regions]
    total = sum(one["count"] for one in regions)
    assert total == found["held_out"]["count"]
    assert np.sqrt(sum(squares) / total) == pytest.approx(found["held_out"]["translation_rms"])
    page = (tmp_path / "out" / "calibration.html").read_text()
    assert page.index("<h2>Workspace") < page.index("<h2>Clocks") < page.index("<h2>Errors")
    assert "with an offset of 500." in page or "with an offset of 499." in page


def test_least_squares_fits_recorded_streams_better_than_the_other_solvers(tmp_path):
    folder = RECORDINGS / "hand_eye" / "vicon"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set the environment variable TWIN_RECORDINGS")
    write_streams(tmp_path)
    for name in ("hand.csv", "camera.csv.gz"):
        data = (folder / f"{name.removesuffix('.gz')}.gz").read_bytes()
        (tmp_path / name).write_bytes(data)
    _, found = calibrated(tmp_path, algebraic.MOST_POSES)
    errors = {name: one["translation_rms"] for name, one in found["solvers"].items()}
    assert errors.pop("least_squares") < min(errors.values())


def test_exchanged_streams_or_a_wrong_mount_fit_as_well_and_cause_no_suspicion(tmp_path):
    write_streams(tmp_path)
    right = calibrated(tmp_path)[1]
    plan = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    exchanged = {"streams": {"hand": "camera.csv.gz", "camera": "hand.csv"}}
    for wrong, noted in ((exchanged, False), ({"camera": {"mount": "world"}}, True)):
        (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan | wrong))
        found = calibrated(tmp_path)[1]
        assert found["suspected"] == []
        sign = -1.0 if wrong is exchanged else 1.0
        assert found["records"]["time_offset"]["value"] == pytest.approx(sign * 0.037, abs=2e-3)
        # Flange and camera have the same rotations, so the fit does not reveal the mistake.
        assert found["held_out"]["rotation_rms"] == pytest.approx(
            right["held_out"]["rotation_rms"], rel=0.3
        )
        assert any("the streams do not determine which" in note for note in found["notes"]) == noted


@pytest.mark.parametrize("seeds", samples(4, always=(1,)))
def test_intervals_of_the_time_offset_contain_the_true_value(tmp_path, seeds):
    inside = []
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        write_streams(folder, seed=seed, noise=2e-3)
        low, high = calibrated(folder)[1]["records"]["time_offset"]["ci95"]
        inside.append(low < 0.037 < high)
    assert sum(inside) >= 0.75 * len(seeds)


def scale_camera(folder: Path, factor: float) -> None:
    """Poses of a target whose stated size is ``factor`` times the real one."""
    found = read_stream(folder / "camera.csv.gz")
    poses = found.poses.copy()
    poses[:, :3, 3] *= factor
    write_stream(folder / "camera.csv.gz", found.time, poses)


@pytest.mark.parametrize("mount", ["hand", pytest.param("world", marks=pytest.mark.nightly)])
def test_intervals_contain_the_tolerance_of_the_targets_size(tmp_path, mount):
    inside = []
    for seed, scale in enumerate((0.997, 1.0035)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        write_streams(folder, seed=seed, noise=1e-3, mount=mount)
        scale_camera(folder, scale)
        status, found = calibrated(folder)
        assert status == 0
        low, high = found["records"]["target_scale"]["ci95"]
        names = {"hand": ("hand_eye", "robot_world"), "world": ("target", "hand_eye")}[mount]
        for name, truth in zip(names, (HAND_EYE, TARGET), strict=True):
            record = found["records"][name]
            inside += [
                record["ci95"][axis][0] < truth[at, 3] < record["ci95"][axis][1]
                for at, axis in enumerate("xyz")
            ]
        assert low < scale < high
        assert any("differ from the stated one by 0.2 %" in note for note in found["notes"])
    assert np.mean(inside) >= 0.85


def test_streams_of_a_target_of_stated_size_have_no_record_of_it(tmp_path):
    write_streams(tmp_path, size_tolerance=0.0)
    found = calibrated(tmp_path)[1]
    assert "target_scale" not in found["records"]
    assert not any("stated one" in note for note in found["notes"])


def test_streams_of_a_target_printed_too_small_are_rejected_with_the_factor(tmp_path):
    write_streams(tmp_path, noise=1e-3)
    scale_camera(tmp_path, 1.0 / 0.97)
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"]) == (1, "rejected")
    assert found["suspected"][0]["factor"] == pytest.approx(0.97, abs=0.005)


def test_a_camera_that_moved_during_the_streams_is_named_with_the_time(tmp_path):
    write_streams(tmp_path)
    found = read_stream(tmp_path / "camera.csv.gz")
    poses = found.poses.copy()
    later = found.time > 25.0
    poses[later] = (
        apply_change(np.eye(4), np.array([0.006, 0.0, 0.0, 0.0, 0.01, 0.0])) @ poses[later]
    )
    write_stream(tmp_path / "camera.csv.gz", found.time, poses)
    status, document = calibrated(tmp_path)
    assert (status, document["verdict"]) == (1, "rejected")
    reason = document["reasons"][0]
    assert "the camera on the flange is elsewhere" in reason
    assert float(reason.split("from observation at ")[1].split(" s")[0]) == pytest.approx(25, abs=1)


def test_a_drift_of_the_clocks_is_estimated_and_noted(tmp_path):
    write_streams(tmp_path, drift=1e-3)
    _, found = calibrated(tmp_path)
    drift = found["records"]["time_offset"]["drift"]
    assert drift["ci95"][0] < 1e-3 < drift["ci95"][1]
    assert any("the clocks drift apart" in note for note in found["notes"])


@pytest.mark.parametrize("step", [0.015, pytest.param(0.05, marks=pytest.mark.nightly), -0.02])
def test_a_step_of_a_clock_is_rejected_with_its_time(tmp_path, step):
    write_streams(tmp_path, step=step)
    status, found = calibrated(tmp_path)
    assert status == 1
    (reason,) = [one for one in found["reasons"] if "ms at once" in one]
    at, size = re.findall(r"near (\d+) s .* about (\d+) ms at once", reason)[0]
    assert int(at) == pytest.approx(20, abs=2)
    assert int(size) == pytest.approx(1e3 * abs(step), abs=5)


def test_a_focal_length_that_is_wrong_by_2_percent_is_rejected_with_the_factor(tmp_path):
    write_streams(tmp_path, depth=1.02, size_tolerance=0.05)
    status, found = calibrated(tmp_path)
    assert status == 1
    assert any("depths of the camera's stream are 0.98" in one for one in found["reasons"])


def test_an_unobservable_drift_of_the_clocks_has_no_value(tmp_path):
    write_streams(tmp_path, burst=0.7, noise=2e-3)
    _, found = calibrated(tmp_path)
    record = found["records"]["time_offset"]
    assert record["ci95"][0] < 0.037 < record["ci95"][1]
    assert (record["drift"]["value"], record["drift"]["ci95"]) == (None, None)
    assert record["drift"]["why"].startswith("the motion does not show a drift of the clocks")
    assert record["drift"]["why"] in found["notes"]


def test_errors_that_grow_with_speed_are_attributed_to_compliance(tmp_path):
    write_streams(tmp_path, sway=0.05, noise=2e-4)
    pattern = calibrated(tmp_path)[1]["held_out"]["pattern"]
    assert pattern["kind"] == "grows_with_speed"
    assert "compliance" in pattern["words"]


def test_streams_of_different_motions_give_no_time_offset(tmp_path):
    write_streams(tmp_path, other_motion=True)
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"], found["records"]) == (1, "degenerate", {})
    assert found["unobservable"][0].startswith("the time offset: ")


def test_a_hand_at_rest_gives_no_time_offset(tmp_path):
    write_streams(tmp_path, slow=0.0)
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"], found["records"]) == (1, "degenerate", {})


def test_stamps_in_milliseconds_are_an_error_with_the_unit(tmp_path):
    write_stream(
        tmp_path / "s.csv", 1e3 * np.arange(0.0, 3.0, 0.01), np.tile(np.eye(4), (300, 1, 1))
    )
    with pytest.raises(FormatError, match="t seems to be in ms"):
        read_stream(tmp_path / "s.csv")


def test_a_large_backward_step_of_the_time_stamps_is_refused_with_its_line(tmp_path):
    time = np.arange(0.0, 30.0, 0.5)
    time[40] -= 5.0
    write_stream(tmp_path / "s.csv", time, np.tile(np.eye(4), (60, 1, 1)))
    with pytest.raises(FormatError, match="the stamps go back") as error:
        read_stream(tmp_path / "s.csv")
    assert error.value.line == 41


def test_samples_out_of_order_are_sorted_and_repeated_ones_removed(tmp_path):
    time = np.arange(0.0, 30.0, 0.5)
    time[10], time[11], time[21] = time[11], time[10], time[20]
    write_stream(tmp_path / "s.csv", time, np.tile(np.eye(4), (60, 1, 1)))
    found = read_stream(tmp_path / "s.csv")
    assert len(found.time) == 59
    assert (np.diff(found.time) > 0).all()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1,0,0,0,0,0,0,2", "a quaternion that is not of unit length"),
        ("1,0,0,0,0,0,1", "not a stamped pose"),
        ("1,0,0,nan,0,0,0,1", "not a stamped pose"),
        ("one,0,0,0,0,0,0,1", "not a stamped pose"),
    ],
)
def test_an_invalid_line_of_a_stream_is_refused_with_its_number(tmp_path, line, words):
    good = [f"{t},0,0,0,0,0,0,1" for t in range(30)]
    (tmp_path / "s.csv").write_text("\n".join([*good[:1], line, *good[2:]]) + "\n")
    with pytest.raises(FormatError, match=words) as error:
        read_stream(tmp_path / "s.csv")
    assert error.value.line == 2


@pytest.mark.parametrize(
    ("stream", "factor", "words"),
    [
        pytest.param("camera", 1000.0, "the camera's stream is ", marks=pytest.mark.nightly),
        ("hand", 1000.0, "the hand's stream is "),
        ("camera", 1.2, "positions of the camera's stream are too large or too small by a factor"),
    ],
)
def test_a_stream_with_a_wrong_unit_or_scale_is_reported(tmp_path, stream, factor, words):
    write_streams(tmp_path)
    path = tmp_path / {"camera": "camera.csv.gz", "hand": "hand.csv"}[stream]
    found = read_stream(path)
    poses = found.poses.copy()
    poses[:, :3, 3] *= factor
    write_stream(path, found.time, poses)
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"]) == (1, "rejected")
    assert found["reasons"][0].startswith(words)
    assert not any("turn the hand" in reason for reason in found["reasons"])


def test_correct_streams_cause_no_suspicion(tmp_path):
    write_streams(tmp_path, noise=5e-3)
    assert calibrated(tmp_path)[1]["suspected"] == []
