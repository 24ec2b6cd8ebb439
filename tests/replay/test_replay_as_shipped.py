"""``pytest-twin replay`` and replay goldens on irregular recordings from real drivers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from replay_trials import ARM, START_NS, recording, series

from pytest_twin import cli
from pytest_twin.checks import check_of
from pytest_twin.checks.base import Observation
from pytest_twin.errors import SpecError
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.gate.specs import load_golden
from pytest_twin.open_loop import replay
from pytest_twin.realization import load
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")

JOINTS = ("shoulder", "elbow")
TIME = 0.01 * np.arange(300)
SENT = np.column_stack([0.4 * np.sin(3 * TIME), 0.3 - 0.2 * np.sin(5 * TIME)])


class Bench:
    """A folder with a twin of an arm and recordings of its own motion."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "arm.xml").write_text(ARM)
        (folder / "twin.yaml").write_text("name: arm\nmodel: arm.xml\ntcp: tool\n")
        self.realization = load(folder / "arm.xml")

    def motion(self, **options: Any) -> np.ndarray:
        """(samples, joints) positions, rad, that the model predicts under the commands."""
        made = make_trial(
            recording(
                series("/joint_states", JOINTS, TIME, position=np.tile(SENT[0], (len(TIME), 1))),
                series("/joint_commands", JOINTS, TIME, position=SENT),
                options,
            )
        )
        return replay(self.realization, [made])[0].position

    def put(
        self,
        state: np.ndarray,
        rows: np.ndarray | slice = slice(None),
        sent: np.ndarray | None = None,
        sent_rows: np.ndarray | slice | None = None,
        metadata: Mapping[str, str] | None = None,
        names: tuple[str, ...] = JOINTS,
    ) -> Path:
        path = self.folder / "moves.mcap"
        commanded = rows if sent_rows is None else sent_rows
        write_recording(
            path,
            [
                series("/joint_states", names, TIME[rows], position=state[rows]),
                series(
                    "/joint_commands", names, TIME[commanded],
                    position=(SENT if sent is None else sent)[commanded],
                ),
            ],
            metadata or {},
        )  # fmt: skip
        return path

    def replay(self, *options: str) -> dict[str, Any]:
        out = self.folder / "out.mcap"
        arguments = ["replay", str(self.folder / "twin.yaml"), str(self.folder / "moves.mcap"),
                     "--out", str(out), *options]  # fmt: skip
        assert cli.main(arguments) == 0
        found: dict[str, Any] = json.loads(out.with_suffix(".json").read_text())
        return found

    def predicted(self) -> tuple[np.ndarray, np.ndarray]:
        state = read_recording(self.folder / "out.mcap").series["state"]
        assert state.position is not None
        return (state.stamp - START_NS) * 1e-9, state.position

    def observe(self, recorded: str = "moves.mcap", **target: Any) -> Observation:
        path = self.folder / "golden" / "replay.yaml"
        path.parent.mkdir(exist_ok=True)
        spec = {"schema": 1, "kind": "replay", "target": {"recording": recorded, **target},
                "tolerance": {"angle_rms": "1 deg"}}  # fmt: skip
        path.write_text(yaml.safe_dump(spec))
        twin = load_twin(self.folder / "twin.yaml")
        golden = load_golden(path, twin)
        realization = load(self.folder / "arm.xml", twin=twin)
        return check_of("replay").observe(golden, realization, lambda _: None)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_recording_with_one_state_is_predicted_at_the_command_stamps(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = bench.motion()
    bench.put(whole, rows=np.array([0]), sent_rows=slice(None, None, 3))
    found = bench.replay()
    time, position = bench.predicted()
    assert time == pytest.approx(TIME[::3])
    assert found["samples"] == 100
    assert found["joints"]["elbow"]["rms"] is None
    assert "elbow     only one state: no comparison" in capsys.readouterr().out
    bench.put(whole, sent_rows=slice(None, None, 3))
    bench.replay()
    assert np.array_equal(position, bench.predicted()[1][::3])


def test_the_prediction_starts_at_the_first_command_if_the_only_state_is_earlier(
    bench: Bench,
) -> None:
    bench.put(bench.motion(), rows=np.array([0]), sent_rows=slice(5, None))
    bench.replay()
    assert bench.predicted()[0] == pytest.approx(TIME[5:])


def test_a_replay_golden_refuses_a_recording_with_one_state(bench: Bench) -> None:
    bench.put(bench.motion(), rows=np.array([0]), sent_rows=slice(None))
    with pytest.raises(SpecError, match="only one state: no comparison with a replay"):
        bench.observe()


def test_joints_in_separate_messages_are_compared_at_their_own_stamps(bench: Bench) -> None:
    state = bench.motion()
    state[:, 1] += 0.01
    state[0] = SENT[0]
    state[1::2, 0], state[2::2, 1] = np.nan, np.nan
    bench.put(state)
    found = bench.replay()
    assert bench.predicted()[0] == pytest.approx(TIME)
    assert found["joints"]["shoulder"]["rms"] < 1e-9
    # 150 of 151 samples have the error: the first is the model's start.
    assert found["joints"]["elbow"]["rms"] == pytest.approx(0.01 * np.sqrt(150 / 151), rel=1e-6)
    values = bench.observe(tcp="tool").values
    assert values["joints"]["elbow"]["rms"] == pytest.approx(found["joints"]["elbow"]["rms"])
    assert values["tcp"]["position"]["rms"] < 1e-9


ROWS_WITH_GAP = np.r_[0:120, 170:300]


def test_after_a_gap_the_replay_restarts_from_the_next_state(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    # Unrecorded commands in the gap moved the arm by 0.3 rad.
    state = bench.motion()
    state[170:] = bench.motion()[170:] + 0.3
    bench.put(state, rows=ROWS_WITH_GAP)
    found = bench.replay()
    time, position = bench.predicted()
    assert time == pytest.approx(TIME[ROWS_WITH_GAP])
    assert position[120] == pytest.approx(state[170])
    assert found["parts"] == [
        {"start": 0.0, "end": pytest.approx(1.19)},
        {"start": pytest.approx(1.7), "end": pytest.approx(2.99)},
    ]
    said = "cut into 2 parts: states and commands are both missing from 1.19 to 1.7 s"
    assert any(said in note for note in found["notes"])
    assert f"note: {said}" in capsys.readouterr().out
    observed = bench.observe()
    assert observed.values["joints"]["elbow"]["at"] > 1.69
    assert any(said in note for note in observed.values["notes"])


def test_command_line_options_define_how_a_recording_is_read(bench: Bench) -> None:
    bench.put(bench.motion(command_between="ramped"), names=("r_shoulder", "r_elbow"))
    held = bench.replay("--joints", "prefix=r_")
    assert held["command_between"] == {"value": "held", "source": "assumed"}
    options = ["--command-between", "ramped", "--command-mode", "position", "--clock", "log"]
    found = bench.replay("--joints", "r_shoulder=shoulder,r_elbow=elbow", *options)
    assert found["command_between"] == {"value": "ramped", "source": "option"}
    assert found["joints"]["elbow"]["rms"] < 1e-9 < held["joints"]["elbow"]["rms"]
    assert "log times are used for both topics, as asked" in found["notes"]


def test_the_twin_file_defines_how_recordings_are_read(bench: Bench) -> None:
    with (bench.folder / "twin.yaml").open("a") as twin:
        twin.write("joints: {prefix: r_}\ncommand_between: interpolated\ncommand_mode: position\n")
    bench.put(bench.motion(command_between="interpolated"), names=("r_shoulder", "r_elbow"))
    found = bench.replay()
    assert found["command_between"] == {"value": "interpolated", "source": "twin.yaml"}
    assert found["joints"]["elbow"]["rms"] < 1e-9
    observed = bench.observe()
    assert observed.values["command_between"] == "interpolated"
    assert observed.values["joints"]["elbow"]["rms"] < 1e-9


def test_the_assumption_of_held_commands_is_printed(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.put(bench.motion())
    bench.replay()
    assert (
        "commands are held between their stamps (assumed; declare it in twin.yaml or with "
        "--command-between)"
    ) in capsys.readouterr().out
    bench.put(bench.motion(), metadata={"command_between": "held"})
    bench.replay()
    assert "(assumed" not in capsys.readouterr().out


def test_replay_supports_effort_and_position_commands_in_one_robot(bench: Bench) -> None:
    torque = ARM.replace(
        '<position name="elbow" joint="elbow" kp="80" kv="4"', '<motor name="elbow" joint="elbow"'
    )
    (bench.folder / "arm.xml").write_text(torque)
    arm = load(bench.folder / "arm.xml")
    nan = np.full(len(TIME), np.nan)
    sent = {
        "position": np.column_stack([SENT[:, 0], nan]),
        "effort": np.column_stack([nan, -1.0 + np.sin(4 * TIME)]),
    }
    start = np.tile([0.0, 0.2], (len(TIME), 1))

    def both(position: np.ndarray) -> list[Any]:
        return [
            series("/joint_states", JOINTS, TIME, position=position),
            series("/joint_commands", JOINTS, TIME, **sent),
        ]

    made: Trial = make_trial(recording(*both(start)), arm.structure)
    (result,) = replay(arm, [made])
    write_recording(bench.folder / "moves.mcap", both(result.position), {})
    found = bench.replay()
    assert found["command_mode"] == "mixed"
    assert found["command_modes"] == {"shoulder": "position", "elbow": "effort"}
    assert found["joints"]["elbow"]["rms"] < 1e-9
    assert np.ptp(result.position[:, 1]) > 0.2


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--joints", "left_"], "expected prefix=TEXT, suffix=TEXT or RECORDED=MODEL"),
        (["--command-mode", "torque"], "expected position, velocity, effort, or JOINT=MODE"),
        (["--command-mode", "elbow=torque"], "expected position, velocity, effort, or JOINT=MODE"),
        (["--clock", "wall"], "invalid choice: 'wall'"),
        (["--command-between", "smooth"], "invalid choice: 'smooth'"),
    ],
)
def test_invalid_reading_options_are_refused(
    option: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["replay", "a.xml", "b.mcap", "--out", "c.mcap", *option])
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
