"""Helpers that write LeRobot data sets of versions 2.1 and 3.0 with pyarrow."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

JOINTS = ("shoulder_pan", "elbow_flex")


def episode(number: int, frames: int, fps: int = 50) -> dict[str, np.ndarray]:
    """Time (s), states and actions (rad) of an episode; all numbers differ."""
    time = np.arange(frames) / fps
    state = np.column_stack([np.sin(time + number), np.cos(2 * time) - number])
    return {"time": time, "state": state, "action": state + 0.01}


def table(
    parts: Sequence[tuple[int, dict[str, np.ndarray]]], dtype: str, scale: float, fixed: bool
) -> pa.Table:
    number = pa.float32() if dtype == "float32" else pa.float64()
    columns: dict[str, Any] = {}
    for name, key in (("observation.state", "state"), ("action", "action")):
        rows = np.concatenate([part[key] for _, part in parts]) * scale
        kind = pa.list_(number, rows.shape[1] if fixed else -1)
        columns[name] = pa.array(rows.astype(dtype).tolist(), kind)
    time = np.concatenate([part["time"] for _, part in parts])
    columns["timestamp"] = pa.array(time.astype(np.float32))
    counts = [len(part["time"]) for _, part in parts]
    columns["frame_index"] = pa.array(np.concatenate([np.arange(n) for n in counts]))
    columns["episode_index"] = pa.array(np.repeat([n for n, _ in parts], counts))
    columns["index"] = pa.array(np.arange(sum(counts)))
    columns["task_index"] = pa.array(np.zeros(sum(counts), np.int64))
    return pa.table(columns)


def write_dataset(
    folder: Path,
    episodes: Sequence[dict[str, np.ndarray]],
    version: str = "v3.0",
    *,
    dtype: str = "float64",
    scale: float = 1.0,
    names: Any = tuple(f"{joint}.pos" for joint in JOINTS),
    fps: int = 50,
    **info: Any,
) -> Path:
    """Write a data set of these episodes; ``info`` overrides fields of info.json."""
    (folder / "meta").mkdir(parents=True)
    width = episodes[0]["state"].shape[1]
    vector = {"dtype": dtype, "shape": [width], "names": names}
    template = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    if version == "v3.0":
        template = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    described = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "total_episodes": len(episodes),
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": template,
        "features": {
            "observation.state": vector,
            "action": vector,
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            "observation.images.top": {"dtype": "video", "shape": [3, 480, 640], "names": None},
        },
        **info,
    }
    (folder / "meta" / "info.json").write_text(json.dumps(described))
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    numbered = list(enumerate(episodes))
    if version == "v3.0":
        half = (len(numbered) + 1) // 2
        for at, part in enumerate(p for p in (numbered[:half], numbered[half:]) if p):
            pq.write_table(table(part, dtype, scale, True), data / f"file-{at:03d}.parquet")
    else:
        for number, one in numbered:
            written = table([(number, one)], dtype, scale, False)
            pq.write_table(written, data / f"episode_{number:06d}.parquet")
    return folder
