"""Replay goldens of LeRobot episodes, and the goldens that ``init`` proposes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from replay_trials import ARM

from pytest_twin.checks import check_of
from pytest_twin.checks.replay import Replay
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.gate import worker
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial
from pytest_twin.twin import load_twin

sys.path.insert(0, str(Path(__file__).parents[1] / "formats"))
from lerobot_files import episode, write_dataset

NAMES = ["shoulder.pos", "elbow.pos"]
BIN = Path(sys.executable).parent


def small_motion(number: int) -> dict[str, np.ndarray]:
    """Motion within the arm's joint range; each episode is longer than the previous one."""
    found = episode(number, 100 + 10 * number)
    return {**found, "state": 0.1 * found["state"], "action": 0.1 * found["action"]}


def write_twin(root: Path, episodes: int) -> Path:
    root.mkdir()
    (root / "arm.xml").write_text(ARM)
    write_dataset(root / "moves", [small_motion(n) for n in range(episodes)], "v2.1", names=NAMES)
    return root


def trials_of(root: Path, **target: Any) -> list[Trial]:
    """The trials that a replay golden with this target reads."""
    (root / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    path = root / "golden" / "moves.yaml"
    path.parent.mkdir(exist_ok=True)
    golden = {
        "schema": 1,
        "kind": "replay",
        "target": {"recording": "moves"} | target,
        "tolerance": {"angle_max": "1 rad"},
    }
    path.write_text(yaml.safe_dump(golden, sort_keys=False))
    twin = load_twin(root / "twin.yaml")
    check = check_of("replay")
    assert isinstance(check, Replay)
    return check.trials(load_golden(path, twin), load(root / "arm.xml", twin=twin))


@pytest.mark.parametrize("number", [0, 2])
def test_a_golden_reads_the_episode_in_its_target(tmp_path: Path, number: int) -> None:
    (trial,) = trials_of(write_twin(tmp_path / "arm", 3), episode=number)
    assert trial.path.name == f"episode_00000{number}"
    np.testing.assert_array_equal(trial.position, small_motion(number)["state"])


@pytest.mark.parametrize(
    ("episodes", "target", "line"),
    [
        (3, {}, "target.recording: a data set of 3 episodes (got 'moves'; expected "
                "target.episode: N with N from 0 to 2)"),
        (3, {"episode": 3}, "target.episode: moves has 3 episodes (got 3; expected 0 to 2)"),
        (1, {"episode": 0}, "target.episode: moves has only one episode (got 0; expected no "
                            "target.episode)"),
    ],
)  # fmt: skip
def test_a_missing_or_impossible_episode_number_is_refused_in_one_line(
    tmp_path: Path, episodes: int, target: dict[str, int], line: str
) -> None:
    root = write_twin(tmp_path / "arm", episodes)
    with pytest.raises(SpecError) as caught:
        trials_of(root, **target)
    assert re.fullmatch(r".*golden/moves\.yaml:\d+: " + re.escape(line), str(caught.value))


@pytest.mark.parametrize("number", [-1, "first", 1.5, True])
def test_an_episode_number_must_be_a_non_negative_integer(tmp_path: Path, number: object) -> None:
    root = write_twin(tmp_path / "arm", 2)
    with pytest.raises(TwinError, match=r"moves\.yaml:\d+: target\.episode: "):
        trials_of(root, episode=number)


def test_the_gate_diagnoses_only_the_episodes_of_its_goldens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_twin(tmp_path / "arm", 4)
    (root / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    read: list[str] = []

    def note_recordings(_: Path, __: Realization, trials: TrialSet, **___: object) -> None:
        # The recordings are selected at this point; the fit itself would take minutes.
        read.extend(trial.path.name for trial in (*trials.fit, *trials.held_out))

    monkeypatch.setattr("pytest_twin.gate.diagnosis_folder.write_diagnosis", note_recordings)
    moves = str(root / "moves")
    out = str(tmp_path)
    worker.diagnose(
        str(root / "twin.yaml"), "mujoco", [(moves, 1)], [(moves, 3)], out, out, lambda _: None
    )
    assert sorted(read) == ["episode_000001", "episode_000003"]


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    state = {"XDG_CONFIG_HOME": str(cwd.parent / "config"), "XDG_STATE_HOME": str(cwd.parent / "s")}
    return subprocess.run(
        [str(BIN / command[0]), *command[1:]],
        cwd=cwd, env={**os.environ, **state}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def test_init_proposes_five_episodes_and_a_changed_data_set_makes_them_stale(
    tmp_path: Path,
) -> None:
    root = write_twin(tmp_path / "arm", 7)
    made = run("pytest-twin", "init", "arm.xml", "moves", "--tolerance", "3rad", cwd=root)
    assert made.returncode == 0, made.stdout + made.stderr
    folder = root / "golden" / "replay"
    assert sorted(p.name for p in folder.iterdir()) == [f"moves_episode_{n}.yaml" for n in range(5)]
    golden = yaml.safe_load((folder / "moves_episode_2.yaml").read_text())
    assert golden["target"] == {"recording": "moves", "episode": 2}
    assert golden["title"].startswith("Replay of moves, episode 2, 2.38 s, ")
    told = json.loads((root / ".twin" / "init.json").read_text())
    assert told["left_out"]["moves"] == (
        "2 of 7 episodes, from 5 to 6; to test one of them too, copy a golden and change its "
        "target.episode"
    )
    released = run("pytest", "--twin-release", cwd=root)
    assert released.returncode == 0, released.stdout[-2000:]
    assert "recording:moves" not in run("pytest", "--twin-why", cwd=root).stdout
    with (root / "moves" / "meta" / "info.json").open("a") as stream:
        stream.write("\n")
    why = run("pytest", "--twin-why", cwd=root).stdout
    assert why.count("recording:moves") >= 5, why
