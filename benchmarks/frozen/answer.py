"""The answer to a row: one line of JSON with what is compared, and nothing that a run changes."""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Answer = dict[str, Any]
DIGITS = 5
"""Significant digits of stored numbers."""


def read(file: Path) -> dict[str, Answer]:
    """Return row -> answer; a line that a killed run left unfinished is not there."""
    if not file.exists():
        return {}
    lines = file.read_text("utf-8").split("\n")
    answers = (json.loads(line) for line in lines[:-1] if line.strip())
    return {answer["row"]: answer for answer in answers}


def append(file: Path, answer: Answer) -> None:
    """Append a line at once, so that a killed run leaves whole lines and several runs may write."""
    line = json.dumps(rounded(answer), separators=(",", ":"), sort_keys=True) + "\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("ab+") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.seek(0, os.SEEK_END)
        if stream.tell():
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                # What a killed run left becomes a line that is not JSON; it is cut off.
                _cut_unfinished(stream.fileno())
        os.write(stream.fileno(), line.encode())
        os.fsync(stream.fileno())


def _cut_unfinished(descriptor: int) -> None:
    size = os.fstat(descriptor).st_size
    content = os.pread(descriptor, size, 0)
    os.ftruncate(descriptor, content.rfind(b"\n") + 1)


def rounded(value: Any) -> Any:
    """Return a value with numbers of :data:`DIGITS` digits; None for one that is not finite."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [rounded(item) for item in value]
    return value


def of_diagnosis(document: Mapping[str, Any]) -> Answer:
    """Return the compared part of ``diagnosis.json``."""
    cost = document.get("cost") or {}
    return {
        "verdict": document["verdict"],
        "findings": [_finding(f) for f in document["findings"]],
        "small_corrections": [_finding(f) for f in document.get("small_corrections", [])],
        "held_out": {
            joint: {key: error[key] for key in ("rms_before", "rms_after", "floor")}
            for joint, error in document["held_out"].items()
        },
        "not_tried": len(document.get("not_tried", [])),
        "simulations": cost.get("simulations"),
    }


def _finding(finding: Mapping[str, Any]) -> Answer:
    return {
        "effect": finding["effect"], "joint": finding["joint"],
        "confidence": finding["confidence"],
        "parameters": {
            name: {"value": p["value"], "ci95": p.get("ci95")}
            for name, p in finding["parameters"].items()
        },
        "alternatives": [
            {key: a[key] for key in ("effect", "joint", "confidence") if key in a}
            for a in finding.get("alternatives", [])
        ],
    }  # fmt: skip


def of_identification(document: Mapping[str, Any]) -> Answer:
    """Return the compared part of ``identification.json``."""
    return {
        "verdict": document["verdict"],
        "stages": {s["stage"]: s["state"] for s in document["stages"]},
        "parameters": {
            name: {"value": p["value"], "ci95": p.get("ci95")}
            for name, p in document["parameters"].items()
        },
        "held_out": {
            joint: {
                key: error[key]
                for key in ("effort_relative", "effort_rms", "position_rms") if key in error
            }
            for joint, error in document["held_out"].items()
        },
        "consistent": document["physical"]["consistent"],
    }  # fmt: skip


def replayed(model: Path, recordings: Sequence[Path]) -> dict[str, dict[str, list[float]]]:
    """Replay a written model on recordings: recording -> joint -> RMS and mean absolute error.

    Errors are in rad or m, of one simulation from the first state. A recording that the model
    cannot replay is not there.
    """
    from pytest_twin.diagnosis.patched.model import PatchedModel
    from pytest_twin.diagnosis.patched.replay import replay_patched
    from pytest_twin.diagnosis.trials import read_trials
    from pytest_twin.errors import TwinError
    from pytest_twin.loaded_model import load_model

    out: dict[str, dict[str, list[float]]] = {}
    try:
        loaded = load_model(model)
        patched = loaded.patched or PatchedModel(tuple(loaded.realization.joints))
    except TwinError:
        return out
    for path in recordings:
        try:
            read_as = read_trials([path], [], loaded.topics, loaded.realization.structure)
            (trial, *_) = [*read_as.fit, *read_as.held_out]
            (predicted,) = replay_patched(loaded.realization, patched, [trial], threads=1)
        except TwinError:
            continue
        columns = [trial.joints.index(j) for j in patched.joints]
        off = predicted.position - trial.position[:, columns]
        out[path.stem] = {
            joint: [float(np.sqrt(np.nanmean(e**2))), float(np.nanmean(np.abs(e)))]
            for joint, e in zip(patched.joints, off.T, strict=True)
        }
    return out
