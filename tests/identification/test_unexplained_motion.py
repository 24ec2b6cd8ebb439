"""What no effect explains stays open: a stage is accepted only if nothing but noise remains."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_identify_simulation import MODEL, NOMINAL, REAL

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")


def write_pushed(path: Path, seed: int) -> Path:
    """Write a run of the real pendulum in which someone pushes it from time to time."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(**REAL))
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.2, 1.5, 4), random.uniform(0, 2 * np.pi, 4)
    pushes = np.repeat(random.choice([-0.4, 0.0, 0.4], 6), 25)
    rows = []
    for at, push in enumerate(pushes):
        time = at * 0.02
        command = 0.3 * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase)).sum()
        rows.append((time, data.qpos[0] + 1e-4 * random.standard_normal(), command))
        data.ctrl[0], data.qfrc_applied[0] = command, push
        mujoco.mj_step(model, data, 4)
    head = "time,swing.position,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def test_pushes_leave_the_closed_loop_open_and_the_reason_names_the_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    *fit, held = (str(write_pushed(tmp_path / f"{seed}.csv", seed)) for seed in (1, 2, 3))
    words = ["identify", str(tmp_path / "model.xml"), *fit, "--held-out", held]
    cli.main([*words, "--command-between", "held", "--out", str(tmp_path / "out")])
    document = json.loads((tmp_path / "out/identification.json").read_text())
    (stage,) = (one for one in document["stages"] if one["stage"] == "closed_loop")
    assert stage["held_out"]["after"] > 3.0
    assert stage["state"] != "accepted"
    assert "noise floors that remain" in stage["why"]
    assert "at swing" in stage["why"]
    assert "closed_loop: " in capsys.readouterr().out
