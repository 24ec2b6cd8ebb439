"""A planar arm with two joints, and records of calibrations and identifications for it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries

UPPER, FORE = 0.4, 0.3
ARM = f"""<mujoco model="planar">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81" timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>
      <joint name="shoulder" axis="0 0 1" range="-2 2" limited="true"/>
      <body name="fore" pos="{UPPER} 0 0">
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="elbow" axis="0 0 1" range="-2 2" limited="true"/>
        <site name="tool" pos="{FORE} 0 0"/>
        <site name="flange" pos="{FORE} 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
</mujoco>
"""
POSES = [{"shoulder": 0.3, "elbow": -0.7}, {"shoulder": -1.1, "elbow": 1.4}]


def jacobian(pose: Mapping[str, float]) -> np.ndarray:
    """Derivative (2, 2) of the tool's x and y by both joint angles, in closed form."""
    one, both = pose["shoulder"], pose["shoulder"] + pose["elbow"]
    return np.array(
        [
            [-UPPER * np.sin(one) - FORE * np.sin(both), -FORE * np.sin(both)],
            [UPPER * np.cos(one) + FORE * np.cos(both), FORE * np.cos(both)],
        ]
    )


def zeros_record(
    covariance: Sequence[Sequence[float]],
    joints: Sequence[str] = ("shoulder", "elbow"),
    ident: str = "zeros",
    held_out: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """A calibration of joint zeros."""
    matrix = np.asarray(covariance, dtype=float)
    spread = 1.96 * np.sqrt(np.abs(np.diag(matrix)))
    return {
        "schema": 1,
        "calibration": ident,
        "verdict": "accepted",
        "records": {
            "joint_zeros": {
                "values": {
                    joint: {"value": 0.01, "unit": "rad", "ci95": [0.01 - s, 0.01 + s]}
                    for joint, s in zip(joints, spread, strict=True)
                }
            }
        },
        "held_out": dict(held_out or {}),
        "covariance": {
            "of": [f"joint_zeros.{joint}" for joint in joints],
            "matrix": matrix.tolist(),
        },
    }


def with_pose(
    record: dict[str, Any],
    name: str,
    frames: tuple[str, str],
    xyz: Sequence[float],
    covariance: np.ndarray,
    stated: np.ndarray | None = None,
) -> dict[str, Any]:
    """The record with an added pose that is uncorrelated with the other unknowns.

    Args:
        covariance: of the fitted pose.
        stated: covariance of the pose in the record, if that is the inverse of the fitted pose.
    """
    labels = ["x", "y", "z", "rx", "ry", "rz"][: len(covariance)]
    together = record["covariance"]
    before = np.reshape(together["matrix"], (len(together["of"]),) * 2)
    grown = np.zeros((len(before) + len(covariance),) * 2)
    grown[: len(before), : len(before)] = before
    grown[len(before) :, len(before) :] = covariance
    stem = f"pose:camera.{name}" if len(labels) == 6 else f"point:{name}"
    together["of"] = [*together["of"], *(f"{stem}.{label}" for label in labels)]
    together["matrix"] = grown.tolist()
    record["records"][name] = {
        "parent": frames[0],
        "child": frames[1],
        "transform": {
            "xyz": list(xyz),
            "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0] if len(labels) == 6 else None,
        },
        "covariance": (covariance if stated is None else stated).tolist(),
        "covariance_of": labels,
    }
    return record


def fit_record(
    names: Sequence[str],
    deviations: Sequence[float],
    units: Sequence[str],
    position_rms: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """An identification with uncorrelated parameters."""
    joints = {"shoulder": {"effort_relative": 0.1}, "elbow": {"effort_relative": 0.1}}
    for joint, value in (position_rms or {}).items():
        joints[joint]["position_rms"] = value
    return {
        "schema": 1,
        "identification": "fitted",
        "verdict": "accepted",
        "stages": [{"stage": "friction", "state": "accepted"}],
        "parameters": {
            name: {"value": 0.5, "unit": unit, "ci95": [0.5 - 1.96 * s, 0.5 + 1.96 * s]}
            for name, s, unit in zip(names, deviations, units, strict=True)
        },
        "covariance": {"names": list(names), "matrix": np.diag(np.square(deviations)).tolist()},
        "held_out": joints,
        "trials": {"fit": ["a.mcap"], "held_out": ["b.mcap"]},
        "fit": {"joint": {"shoulder": {"damping": 0.5}}},
    }


def make_twin(
    folder: Path,
    calibrations: Sequence[Mapping[str, Any]] = (),
    fits: Sequence[Mapping[str, Any]] = (),
    budget: str = "",
    use: str = "[joint_zeros, base_world]",
    arm: str = ARM,
) -> Path:
    """Write a twin with these records and return the path of its ``twin.yaml``."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.xml").write_text(arm)
    text = "model: arm.xml\n"
    for key, records in (("calibrations", calibrations), ("fit", fits)):
        text += f"{key}:\n" if records else ""
        for at, record in enumerate(records):
            (folder / f"{key}{at}.json").write_text(json.dumps(record))
            used = f", use: {use}" if key == "calibrations" else ""
            text += f"  - {{file: {key}{at}.json{used}}}\n"
    path = folder / "twin.yaml"
    path.write_text(text + budget)
    return path


def declared(poses: Sequence[Mapping[str, float]] = POSES, more: str = "") -> str:
    """The section ``budget:`` of ``twin.yaml`` with a frame and poses."""
    return f"budget:\n  frame: tool\n  poses: {json.dumps(list(poses))}\n{more}"


def record_motion(
    path: Path,
    position: np.ndarray,
    effort: np.ndarray,
    joints: tuple[str, ...] = ("shoulder", "elbow"),
    velocity: np.ndarray | None = None,
    payload: str = "",
) -> None:
    """Write a recording with commanded efforts; the sample period is 10 ms."""
    stamps = 10_000_000 * np.arange(len(position), dtype=np.int64) + 10**18
    series = [
        JointSeries("/joint_states", joints, stamps, stamps, position, velocity, None),
        JointSeries("/joint_commands", joints, stamps, stamps, None, None, effort),
    ]
    stated = {"payload": payload} if payload else {}
    write_recording(path, series, {"command_between": "held"} | stated)
