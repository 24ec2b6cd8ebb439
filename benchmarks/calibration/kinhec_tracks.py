"""Compare the calibration of KinHEC sequences with KinHEC's reference solvers.

    pip install "kinhec>=1.1"
    kinhec generate --tier small --out kinhec_small
    python benchmarks/calibration/kinhec_tracks.py kinhec_small

KinHEC (Aiersilan, MIT licence) draws robots, cameras, noise and motions. Its own benchmark gives
every solver the same keyframes and compares the transform X of the flange to the camera or target
with the truth. Errors are medians: angle in degrees, distance in mm.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from kinhec import benchmark, load_manifest, load_sequence
from kinhec.metrics import calibration_errors

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.clocks.calibrate_streams import calibrate_streams
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Accept, HoldOut, Plan, Priors
from pytest_twin.errors import TwinError
from pytest_twin.metrics.pose import rotation_of

OURS = "pytest-twin"


def plan_of(mount: str, streams: dict[str, Path] | None = None) -> Plan:
    """Return a plan for hand-eye and robot-world that accepts any error."""
    return Plan(
        id="kinhec", path=Path("calibration.yaml"), robot=None, flange="flange",
        observations=(Path("observations.csv"),), streams=streams or {},
        estimate=("hand_eye", "robot_world"), mount=mount,  # type: ignore[arg-type]
        camera={}, target={}, points={}, given={}, priors=Priors(), hold_out=HoldOut(0.0),
        accept=Accept(),
    )  # fmt: skip


def transforms(document: dict[str, Any], mount: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return X and Y of ``A X = Y B``; None if the calibration refuses them."""
    records = document["records"]
    names = ("hand_eye", "robot_world") if mount == "hand" else ("target", "robot_world")
    if not all(name in records for name in names):
        return None
    found = []
    for name in names:
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(records[name]["transform"]["quaternion_wxyz"])
        pose[:3, 3] = records[name]["transform"]["xyz"]
        found.append(pose)
    return found[0], found[1]


def of_poses(sequence: Any) -> dict[str, Any]:
    """Calibrate from the keyframes that every solver gets."""
    flange, seen, _, _ = benchmark._keyframe_data(sequence, None)
    mount = "hand" if sequence.eye_in_hand else "world"
    poses = np.linalg.inv(seen) if mount == "hand" else seen
    observations = Observations(
        ids=tuple(str(i) for i in range(len(flange))), flange=flange, camera_from_target=poses
    )
    document = calibrate(plan_of(mount), observations, None)
    if not any("scale: estimate" in one["mend"] for one in document["suspected"]):
        return document
    # As the report advises, declare that the camera has no metric scale, and run again.
    plan = replace(plan_of(mount), camera={"scale": "estimate"})
    return {**calibrate(plan, observations, None), "told": True}


def of_streams(sequence: Any) -> dict[str, Any]:
    """Calibrate from two streams on two clocks."""
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for name, time, poses in (
            ("hand", sequence.robot.t, sequence.robot.T_base_ee_meas),
            ("camera", sequence.camera.t, sequence.camera.T_cam_target_meas),
        ):
            there = np.isfinite(poses).all(axis=(1, 2))
            quaternion = benchmark.se3.pose_to_pq(poses[there])
            table = np.column_stack([time[there], quaternion[:, :3], quaternion[:, 4:],
                                     quaternion[:, 3]])  # fmt: skip
            files[name] = Path(folder) / f"{name}.csv"
            np.savetxt(files[name], table, delimiter=",", fmt="%.12g")
        mount = "hand" if sequence.eye_in_hand else "world"
        return calibrate_streams(plan_of(mount, files))


def ours(sequence: Any) -> dict[str, Any]:
    """Return a row of results in the format of KinHEC's benchmark."""
    row: dict[str, Any] = {"sequence_id": sequence.id, "solver": OURS, "ok": False, "error": "",
                           "told": False}  # fmt: skip
    solve: Callable[[Any], dict[str, Any]] = of_poses if sequence.synchronous else of_streams
    try:
        document = solve(sequence)
    except TwinError as error:
        return row | {"error": str(error)}
    if "time_offset" in document["records"]:
        value = document["records"]["time_offset"]["value"]
        # Our offset is added to the camera's stamps; KinHEC's is subtracted.
        row["time_offset_err_ms"] = 1e3 * abs(-value - sequence.time_offset)
    row["told"] = "told" in document
    if "scale" in document["records"]:
        stated = document["records"]["scale"]
        row["scale_err_rel"] = abs(stated["value"] - sequence.scale) / sequence.scale
        low, high = stated["ci95"]
        row["scale_inside"] = low <= sequence.scale <= high
        # If the scale drifts, its mean along the path is taken as the true value.
        mean = float(np.mean(sequence.extra["scale_per_frame"]))
        row["mean_scale_inside"] = low <= mean <= high
        config = json.loads(sequence.manifest["config_json"])
        drifts = (
            float(config["scale"]["drift_std"]) > 0.0,
            config["camera_noise"]["model"] == "vo_drift",
        )
        row["drift"] = {
            (False, False): "no drift",
            (False, True): "drift of the pose",
            (True, False): "drift of the scale",
            (True, True): "drift of both",
        }[drifts]
    found = transforms(document, "hand" if sequence.eye_in_hand else "world")
    if document["verdict"] == "degenerate" or found is None:
        return row | {"error": "; ".join(document["unobservable"])[:200]}
    return row | {"ok": True} | calibration_errors(found[0], sequence.X, found[1], sequence.Y)


def results(root: Path, most: int | None, tracks: list[str] | None) -> pd.DataFrame:
    """Return a row for each sequence and solver, for the reference solvers and ours."""
    manifest = load_manifest(root)
    rows: list[dict[str, Any]] = []
    for track, mine in manifest.groupby("track"):
        if tracks and track not in tracks:
            continue
        chosen = mine["sequence_id"].tolist()
        if most is not None and len(chosen) > most:
            even = np.linspace(0, len(chosen) - 1, most).astype(int)
            chosen = [chosen[at] for at in even]
        for number, name in enumerate(chosen):
            sequence = load_sequence(root, name, manifest)
            mode = "oracle" if sequence.synchronous else "estimated"
            theirs = benchmark.evaluate_sequence(
                sequence, list(benchmark.SOLVERS), mode, np.random.default_rng(number)
            )
            tags = {"group": group_of(sequence, str(track))}
            rows += [one | tags for one in theirs] + [ours(sequence) | tags]
        print(f"{track}: {len(chosen)} sequences", file=sys.stderr, flush=True)
    return pd.DataFrame(rows)


def group_of(sequence: Any, track: str) -> str:
    """Return the track and, for motions, what is varied and whether it determines X."""
    tags = json.loads(sequence.manifest["config_json"]).get("tags", {})
    if track == "robot_error" or "subtrack" not in tags:
        return track
    if tags["subtrack"] == "cone":
        return "motion, one axis" if tags["cone_half_angle_deg"] == 0 else "motion, cone of axes"
    if tags["subtrack"] == "joint_subsets":
        lacking = tags["subset"] in ("single", "parallel")
        return "motion, one axis" if lacking else "motion, some joints"
    return "motion, few poses"


def table(found: pd.DataFrame) -> str:
    """Return a Markdown table: our solver, the best reference solver, and failures."""
    lines = [
        "| track | sequences | pytest-twin: refused | pytest-twin | best reference | its name | "
        "worst of pytest-twin | of that reference |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for group, mine in found.groupby("group"):
        us = mine[mine["solver"] == OURS]
        solved = us[us["ok"]]
        others = mine[(mine["solver"] != OURS) & mine["ok"]]
        best = others.groupby("solver")["X_trans_err_mm"].median().idxmin()
        theirs = others[others["solver"] == best]

        def median(rows: pd.DataFrame) -> str:
            if not len(rows):
                return ""
            angle, distance = rows["X_rot_err_deg"].median(), rows["X_trans_err_mm"].median()
            return f"{angle:.3f} deg, {distance:.2f} mm"

        def worst(rows: pd.DataFrame) -> str:
            return f"{rows['X_trans_err_mm'].max():.1f} mm" if len(rows) else ""

        lines.append(
            f"| {group} | {len(us)} | {len(us) - len(solved)} | {median(solved)} | "
            f"{median(theirs)} | {best} | {worst(solved)} | {worst(theirs)} |"
        )
    return "\n".join(lines)


def compared(found: pd.DataFrame) -> str:
    """Count the sequences of each track in which our distance is smaller than the best one."""
    lines = []
    for group, mine in found.groupby("group"):
        errors = mine[mine["ok"]].pivot_table(
            index="sequence_id", columns="solver", values="X_trans_err_mm"
        )
        if OURS not in errors:
            continue
        best = errors.drop(columns=OURS).median().idxmin()
        both = errors[[OURS, best]].dropna()
        ratio = float(np.exp(np.log(both[OURS] / both[best]).mean()))
        lines.append(
            f"{group}: nearer than {best} in {int((both[OURS] < both[best]).sum())} of {len(both)} "
            f"sequences, with {ratio:.2f} times its error (geometric mean)"
        )
    return "\n".join(lines)


def scales(found: pd.DataFrame) -> str:
    """Count sequences with a detected missing metric scale, and return the error of the scale.

    For each kind of drift, the distances of our solver and of the best reference are listed.
    """
    lines = []
    for group, mine in found[found["solver"] == OURS].groupby("group"):
        told = mine[mine["told"].astype(bool)]
        if not len(told) or "scale_err_rel" not in told:
            continue
        lines.append(
            f"{group}: no metric scale recognised in {len(told)} of {len(mine)} sequences; "
            f"scale off by {100 * told['scale_err_rel'].median():.2f} % (median)"
        )
        for drift, some in told.groupby("drift"):
            those = found[found["sequence_id"].isin(some["sequence_id"]) & found["ok"]]
            medians = those.groupby("solver")["X_trans_err_mm"].median()
            best = medians.drop(OURS, errors="ignore").idxmin()
            lines.append(
                f"  {drift}, {len(some)} sequences: the interval holds the first scale in "
                f"{int(some['scale_inside'].sum())}, the mean along the way in "
                f"{int(some['mean_scale_inside'].sum())}; {medians.get(OURS, np.nan):.2f} mm, "
                f"{best} {medians[best]:.2f} mm"
            )
    return "\n".join(lines)


def offsets(found: pd.DataFrame) -> str:
    """Median error of the time offset: ours, and by correlation only, as in the references."""
    if "time_offset_err_ms" not in found:
        return ""
    known = found.dropna(subset=["time_offset_err_ms"])
    lines = []
    for group, mine in known[known["group"] == "temporal"].groupby("group"):
        us = mine["solver"] == OURS
        # The references of a sequence share one offset.
        theirs = mine[~us].groupby("sequence_id")["time_offset_err_ms"].first()
        lines.append(
            f"{group}: time offset off by {mine[us]['time_offset_err_ms'].median():.2f} ms, by "
            f"correlation alone {theirs.median():.2f} ms (medians)"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path, help="folder that kinhec generate wrote")
    parser.add_argument("--most", type=int, help="sequences of each track, evenly chosen")
    parser.add_argument("--tracks", nargs="+", help="names of tracks; all of them by default")
    parser.add_argument("--csv", type=Path, help="all results, one row for each solver")
    arguments = parser.parse_args()
    # Reference solvers warn of singular matrices where motions are degenerate.
    warnings.simplefilter("ignore")
    found = results(arguments.data, arguments.most, arguments.tracks)
    if arguments.csv:
        found.to_csv(arguments.csv, index=False)
    for text in (table(found), compared(found), scales(found), offsets(found)):
        if text:
            print(text)


if __name__ == "__main__":
    main()
