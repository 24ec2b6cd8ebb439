"""Calibrate recorded robots with ``pytest-twin calibrate`` and print held-out errors.

    TWIN_RECORDINGS=recordings python benchmarks/calibration/recorded_cells.py [--only NAME]

``charuco``: a board on a flange and a fixed camera; ``sim`` and ``vicon``: a hand and a camera on
two clocks; ``tiago``: markers on a hand in the frame of a tracker.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gzip
import io
import json
import os
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pytest_twin import cli
from pytest_twin.metrics.pose import rigid, rotation_of

MAKERS_INTRINSICS = {"fx": 1352.03, "fy": 1356.14, "cx": 789.67, "cy": 627.30}
BOARD = {
    "kind": "charuco", "squares": [5, 7], "square": 0.036195, "marker": 0.018256,
    "dictionary": "DICT_6X6_250",
}  # fmt: skip
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def calibrated(folder: Path, plan: dict[str, Any]) -> dict[str, Any]:
    """Return ``calibration.json``, and the time of the calibration in this process, s."""
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    before = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        status = cli.main(["calibrate", str(folder / "plan.yaml"), "--out", str(folder / "out")])
    if status == 2:
        raise SystemExit(f"{plan['calibration']}: not usable")
    found: dict[str, Any] = json.loads((folder / "out" / "calibration.json").read_text())
    found["seconds"] = time.process_time() - before
    return found


def scatter(found: dict[str, Any], flanges: dict[str, np.ndarray]) -> float:
    """RMS distance of the target on the flange from its mean position, m.

    It includes all held-out images in which the target was found, also excluded gross errors.
    """
    where = found["records"]["hand_eye"]["transform"]
    camera = rigid(rotation_of(where["quaternion_wxyz"]), np.array(where["xyz"]))
    places = []
    for name in found["held_out"]["ids"]:
        seen = found["images"].get(name, {}).get("camera_from_target")
        if seen is not None:
            target = camera @ rigid(rotation_of(seen[3:]), np.array(seen[:3]))
            places.append((np.linalg.inv(flanges[name]) @ target)[:3, 3])
    apart = np.array(places) - np.mean(places, axis=0)
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def charuco(source: Path, folder: Path, draws: int) -> None:
    """RMS errors over random thirds of the images, with and without free intrinsics."""
    shutil.copytree(source / "charuco" / "images", folder / "images")
    flanges = {}
    with (folder / "observations.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["id", "image", *(f"flange.{name}" for name in POSE)])
        for image in sorted((folder / "images").iterdir()):
            pose = yaml.safe_load((source / "charuco/poses" / f"{image.stem}.yaml").read_text())
            values = [float(pose[name]) for name in POSE]
            writer.writerow([image.stem, f"images/{image.name}", *values])
            flanges[image.stem] = rigid(rotation_of(values[3:]), np.array(values[:3]))
    for estimate in (["hand_eye", "base_world"], ["hand_eye", "base_world", "intrinsics"]):
        errors, everything, apart, left_out, seconds = [], [], [], [], []
        for seed in range(draws):
            found = calibrated(folder, {
                "calibration": "charuco", "observations": "observations.csv",
                "estimate": estimate, "target": BOARD, "hold_out": {"fraction": 0.33, "seed": seed},
                "camera": {"mount": "world", "intrinsics": MAKERS_INTRINSICS},
            })  # fmt: skip
            held_out = found["held_out"]
            errors.append(held_out["translation_rms"])
            # Held-out images that were excluded as gross errors are included.
            everything.append(held_out.get("with_excluded", held_out)["translation_rms"])
            apart.append(scatter(found, flanges))
            left_out += [one["id"] for one in found["excluded"]]
            seconds.append(found["seconds"])
        print(
            f"charuco, {', '.join(estimate)}: {1e3 * np.mean(errors):.2f} mm of {draws} draws "
            f"({1e3 * min(errors):.2f} to {1e3 * max(errors):.2f}), median "
            f"{1e3 * np.median(errors):.2f} mm; with held-out images that were left out "
            f"{1e3 * np.mean(everything):.2f} mm; scatter of the target on the flange, distances, "
            f"{1e3 * np.mean(apart):.2f} mm, median {1e3 * np.median(apart):.2f} mm; "
            f"left out: {dict(Counter(left_out).most_common())}; "
            f"{np.median(seconds):.1f} s of processor time each",
            flush=True,
        )


def streams(name: str, source: Path, folder: Path, draws: int) -> None:
    """Offset, and held-out errors with this offset and with the offset of the correlation."""
    folder.mkdir()
    for one in ("hand", "camera"):
        data = gzip.decompress((source / "hand_eye" / name / f"{one}.csv.gz").read_bytes())
        (folder / f"{one}.csv").write_bytes(data)
    for seed in range(draws):
        found = calibrated(folder, {
            "calibration": name, "streams": {"hand": "hand.csv", "camera": "camera.csv"},
            "estimate": ["time_offset", "hand_eye", "robot_world"], "camera": {"mount": "hand"},
            "hold_out": {"fraction": 0.33, "seed": seed},
        })  # fmt: skip
        if found["unobservable"]:
            print(f"{name}: {found['unobservable']}")
            continue
        offset = found["records"]["time_offset"]
        eye = found["records"]["hand_eye"]
        solvers = {key: one["translation_rms"] for key, one in found["solvers"].items()}
        ours = solvers.pop("least_squares")
        best = min(solvers, key=solvers.__getitem__)
        low, high = offset["ci95"]
        drift = offset["drift"]["value"]
        print(
            f"{name}, draw {seed}: offset {1e3 * offset['value']:.2f} ms ({1e3 * low:.2f} to "
            f"{1e3 * high:.2f}), correlation alone {1e3 * offset['from_correlation_alone']:.2f} ms;"
            f" drift {'not shown' if drift is None else f'{1e6 * drift:.0f} us/s'}; "
            f"hand-eye {np.round(1e3 * np.array(eye['transform']['xyz']), 1).tolist()} mm; "
            f"held out {1e3 * ours:.2f} mm, {best} {1e3 * solvers[best]:.2f} mm; distances "
            f"{1e3 * found['held_out']['distance_rms']:.2f} mm; {found['seconds']:.1f} s",
            flush=True,
        )


def tiago(source: Path, folder: Path) -> None:
    """Leave-one-out errors of the markers without and with joint zeros; what was left out."""
    folder.mkdir()
    shutil.copy(source / "tiago" / "tiago.urdf", folder)
    with (source / "tiago" / "mocap.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    names = [
        f"joint.{name}" if name.endswith("joint") else f"point.m{name[1]}.{name[0]}"
        for name in rows[0]
    ]
    with (folder / "observations.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["id", *names])
        writer.writerows([number, *row.values()] for number, row in enumerate(rows))
    for estimate in (["base_world"], ["base_world", "joint_zeros"]):
        found = calibrated(folder, {
            "calibration": "tiago", "robot": "tiago.urdf", "flange": "arm_tool_link",
            "observations": "observations.csv", "estimate": estimate, "hold_out": {"fraction": 0.0},
        })  # fmt: skip
        out = found["fitted"]["leave_one_out"]
        print(
            f"tiago, {', '.join(estimate)}: leave-one-out {1e3 * out['translation_rms']:.2f} mm, "
            f"left out: {[one['id'] for one in found['excluded']]}; {found['seconds']:.1f} s",
            flush=True,
        )
        for joint, one in found["records"].get("joint_zeros", {}).get("values", {}).items():
            low, high = one["ci95"]
            print(f"  {joint}: {1e3 * one['value']:.1f} mrad ({1e3 * low:.1f} to {1e3 * high:.1f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", choices=["charuco", "sim", "vicon", "tiago"])
    parser.add_argument("--draws", type=int, default=20, help="random thirds of images or time")
    arguments = parser.parse_args()
    if "TWIN_RECORDINGS" not in os.environ:
        raise SystemExit("no recordings: the environment variable TWIN_RECORDINGS says where")
    source = Path(os.environ["TWIN_RECORDINGS"])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in ("tiago", "vicon", "sim", "charuco"):
            if arguments.only not in (None, name):
                continue
            if name == "charuco":
                charuco(source, folder, arguments.draws)
            elif name == "tiago":
                tiago(source, folder / name)
            else:
                streams(name, source, folder / name, min(arguments.draws, 4))


if __name__ == "__main__":
    main()
