"""``pytest-twin convert`` and ``pytest-twin show`` for recordings of all formats."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from replay_trials import ARM, series

from pytest_twin import cli
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import JointSeries, Recording

sys.path.insert(0, str(Path(__file__).parents[1] / "formats"))
from lerobot_files import episode, write_dataset

pytestmark = pytest.mark.usefixtures("commands_in_process")

JOINTS = ("shoulder", "elbow")
TIME = np.arange(200) * 0.01


@pytest.fixture
def recording() -> Recording:
    position = np.column_stack([0.4 * np.sin(3 * TIME), -0.2 * np.sin(5 * TIME)])
    sent = np.column_stack([0.4 * np.sin(3 * TIME + 0.1), -0.2 * np.sin(5 * TIME + 0.1)])
    return Recording(
        Path("given"),
        {
            "state": series("/joint_states", JOINTS, TIME, position=position, effort=-position),
            "command": series("/joint_commands", JOINTS, TIME, position=sent),
        },
        {"role": "held_out", "payload": "kg05"},
        (),
    )


def as_csv(recording: Recording, path: Path) -> Path:
    """Write the recording as CSV; each number in the shortest text with the same value."""
    state, command = recording.series["state"], recording.series["command"]
    assert state.position is not None
    assert state.effort is not None
    assert command.position is not None
    names = [f"{joint}.position" for joint in JOINTS] + [f"{joint}.effort" for joint in JOINTS]
    names += [f"{joint}.command" for joint in JOINTS]
    table = np.hstack([state.position, state.effort, command.position])
    rows = [
        ",".join([str(stamp), *(repr(float(value)) for value in row)])
        for stamp, row in zip(state.stamp.tolist(), table, strict=True)
    ]
    path.write_text("\n".join([",".join(["time", *names]), *rows]) + "\n")
    return path


def assert_same(found: JointSeries, expected: JointSeries) -> None:
    assert found.names == expected.names
    np.testing.assert_array_equal(found.stamp, expected.stamp)
    for name in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_convert_writes_csv_as_mcap_with_identical_numbers(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, out = as_csv(recording, tmp_path / "log.csv"), tmp_path / "log.mcap"
    assert cli.main(["convert", str(given), "--out", str(out)]) == 0
    written = read_recording(out)
    for role in ("state", "command"):
        assert_same(written.series[role], recording.series[role])
    said = capsys.readouterr().out
    assert "200 states and 200 commands of 2 joints over 1.99 s" in said
    assert "note: the commands are taken as position commands" in said
    summary = json.loads((tmp_path / "log.json").read_text())
    (one,) = summary["written"]
    assert one["file"] == str(out)
    assert one["topics"]["state"]["fields"] == ["position", "effort"]


@pytest.mark.parametrize(
    ("mode", "filled"),
    [("effort", ["effort"]), (None, ["position", "velocity", "effort"])],
)
def test_commands_unlike_the_positions_fill_all_fields_unless_a_mode_is_given(
    tmp_path: Path, mode: str | None, filled: list[str]
) -> None:
    rows = "".join(f"{t:.2f},{0.1 * np.sin(t)},{90 * np.cos(9 * t)}\n" for t in TIME)
    (tmp_path / "log.csv").write_text("time,a.position,a.command\n" + rows)
    options = [] if mode is None else ["--command-mode", mode]
    out = tmp_path / "log.mcap"
    assert cli.main(["convert", str(tmp_path / "log.csv"), "--out", str(out), *options]) == 0
    command = read_recording(out).series["command"]
    assert [q for q in ("position", "velocity", "effort") if getattr(command, q) is not None] == (
        filled
    )


def test_convert_keeps_metadata_and_missing_samples_and_renames_topics(
    recording: Recording, tmp_path: Path
) -> None:
    state = recording.series["state"]
    assert state.position is not None
    holes = state.position.copy()
    holes[1::2, 0] = np.nan
    partial = series("/arm/states", JOINTS, TIME, position=holes)
    write_recording(tmp_path / "given.mcap", [partial], dict(recording.metadata))
    words = [str(tmp_path / "given.mcap"), "--out", str(tmp_path / "out.mcap")]
    assert cli.main(["convert", *words, "--topics", "state=/arm/states"]) == 0
    written = read_recording(tmp_path / "out.mcap")
    assert written.metadata == {"role": "held_out", "payload": "kg05"}
    assert written.series["state"].topic == "/joint_states"
    assert_same(written.series["state"], partial)
    assert written.damage == ()


def test_converting_several_recordings_writes_numbered_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = write_dataset(tmp_path / "set", [episode(0, 60), episode(1, 40)])
    (tmp_path / "log.csv").write_text("time,a.position\n0.0,1\n0.1,2\n")
    words = [str(dataset), str(tmp_path / "log.csv"), "--out", str(tmp_path / "all.mcap")]
    assert cli.main(["convert", *words]) == 0
    names = [f"all_00{number}.mcap" for number in range(3)]
    assert sorted(p.name for p in tmp_path.glob("all*.mcap")) == names
    counts = [len(read_recording(tmp_path / name).series["state"].stamp) for name in names]
    assert counts == [60, 40, 2]
    said = capsys.readouterr().out
    assert all(name in said for name in names)
    assert "note: no commands" in said


def test_negative_times_are_shifted_by_whole_seconds_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.csv").write_text("time,a.position\n-0.5,1\n0.25,2\n")
    out = tmp_path / "log.mcap"
    assert cli.main(["convert", str(tmp_path / "log.csv"), "--out", str(out)]) == 0
    assert read_recording(out).series["state"].stamp.tolist() == [500_000_000, 1_250_000_000]
    assert "all times are 1 s later: ROS has no negative times" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "out", "words"),
    [
        (
            "log.csv",
            "out.csv",
            "out.csv: not a file name of a recording (expected --out FILE.mcap)",
        ),
        ("log.csv", "no/out.mcap", "no: no such folder"),
        ("given.mcap", "given.mcap", "would overwrite the recording itself"),
        ("bag", "bag/out.mcap", "would overwrite the recording itself"),
        ("nothing", "out.mcap", "nothing: no such file or folder"),
        ("given.mcap", "out.mcap", "neither states nor commands (expected /js (200 "),
    ],
)
def test_convert_reports_unusable_input_in_one_line_and_writes_no_file(
    recording: Recording,
    tmp_path: Path,
    given: str,
    out: str,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    as_csv(recording, tmp_path / "log.csv")
    other = series("/js", JOINTS, TIME, position=np.zeros((200, 2)))
    write_recording(tmp_path / "given.mcap", [other])
    (tmp_path / "bag").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["convert", str(tmp_path / given), "--out", str(tmp_path / out)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert words in said.err
    assert sorted(tmp_path.rglob("*")) == before


def test_replay_predicts_the_same_from_mcap_and_csv(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    write_recording(tmp_path / "log.mcap", list(recording.series.values()))
    as_csv(recording, tmp_path / "log.csv")
    found = []
    for name in ("log.mcap", "log.csv"):
        out = tmp_path / f"out_{name.replace('.', '_')}.mcap"
        words = [str(tmp_path / "arm.xml"), str(tmp_path / name), "--out", str(out)]
        assert cli.main(["replay", *words]) == 0
        found.append(read_recording(out).series["state"])
    assert_same(found[0], found[1])


# -- show --------------------------------------------------------------------------------------


def output_of_show(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert cli.main(["show", str(path), *options]) == 0
    return capsys.readouterr().out


def test_show_lists_the_contents_of_a_recording_and_the_next_command(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "moves.mcap"
    write_recording(path, list(recording.series.values()), dict(recording.metadata))
    said = output_of_show(path, capsys)
    assert f"{path}: MCAP file, 1.99 s" in said
    assert "200  sensor_msgs/msg/JointState  shoulder, elbow  <- command" in said
    assert "states: 200 messages of 2 joints at 100 Hz, position and effort" in said
    assert "trial metadata: payload kg05, role held_out" in said
    assert "A diagnosis can use 1.99 s of it: position commands of shoulder, elbow" in said
    assert f"next: pytest-twin diagnose MODEL {path}" in said


def test_show_suggests_topics_when_the_usual_ones_are_missing(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, command = recording.series["state"], recording.series["command"]
    path = tmp_path / "moves.mcap"
    topics = {"/arm/joint_states": state, "/arm/commands": command, "/hand/states": state}
    write_recording(
        path,
        [
            series(topic, JOINTS, TIME, position=one.position, effort=one.effort)
            for topic, one in topics.items()
        ],
    )
    said = output_of_show(path, capsys)
    line = next(line for line in said.splitlines() if line.startswith("missing: "))
    assert "no states and no commands on the usual topics; try" in line
    assert line.split("try ")[1].startswith(
        "--topics state=/arm/joint_states,command=/arm/commands"
    )
    assert "Without a model, its use cannot be told: a twin.yaml may name topics" in said
    assert f"(pytest-twin show MODEL {path})" in said
    option = "state=/arm/joint_states,command=/arm/commands"
    assert "A diagnosis can use" in output_of_show(path, capsys, "--topics", option)


def test_show_with_a_model_reads_the_recording_as_its_commands_do(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    twin = tmp_path / "twin.yaml"
    twin.write_text("name: arm\nmodel: arm.xml\ntopics: {command: /sent}\njoints: {prefix: l_}\n")
    names = ("l_shoulder", "l_elbow", "l_wheel")
    three = np.zeros((len(TIME), 3))
    topics = ("/joint_states", "/sent")
    log = tmp_path / "log.mcap"
    write_recording(log, [series(topic, names, TIME, position=three) for topic in topics])
    assert "Without a model" in output_of_show(log, capsys)
    said = output_of_show(twin, capsys, str(log))
    assert "position commands of shoulder, elbow, held between stamps" in said
    assert "left out, not in the model: l_wheel" in said
    assert f"next: pytest-twin diagnose {twin} {log}" in said
    (tmp_path / "other.xml").write_text(ARM.replace("elbow", "knee").replace("shoulder", "hip"))
    said = output_of_show(tmp_path / "other.xml", capsys, str(log), "--topics", "command=/sent")
    assert "missing: " in said
    assert f"A diagnosis of {tmp_path / 'other.xml'} cannot use this recording." in said


def test_show_of_a_model_alone_asks_for_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    assert cli.main(["show", str(tmp_path / "arm.xml")]) == 2
    error = capsys.readouterr().err
    assert (
        f"a model, not a recording (expected pytest-twin show {tmp_path / 'arm.xml'} REC" in error
    )


def test_replay_suggests_topics_when_the_usual_ones_are_missing(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    command = recording.series["command"]
    moved = series("/arm/commands", JOINTS, TIME, position=command.position)
    write_recording(tmp_path / "moves.mcap", [recording.series["state"], moved])
    words = [str(tmp_path / "arm.xml"), str(tmp_path / "moves.mcap")]
    assert cli.main(["replay", *words, "--out", str(tmp_path / "out.mcap")]) == 2
    said = capsys.readouterr().err
    assert "/arm/commands (200 sensor_msgs/msg/JointState of shoulder, elbow)" in said
    assert "--topics state=/joint_states,command=/arm/commands" in said


def test_show_writes_gaps_rates_and_advice_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = np.concatenate([TIME[:100], TIME[100:] + 0.5])
    position = np.column_stack([np.sin(3 * time), np.zeros(200)])
    late = series("/joint_states", JOINTS, time, position=position)
    sent = series("/joint_commands", JOINTS, time, position=position + 1e-3)
    write_recording(tmp_path / "moves.mcap", [late, sent])
    document = json.loads(output_of_show(tmp_path / "moves.mcap", capsys, "--json", "-"))
    (one,) = document["recordings"]
    assert one["series"]["state"]["rate"]["value"] == pytest.approx(100.0)
    (gap,) = one["series"]["state"]["gaps"]
    assert (gap["start"], gap["end"]) == pytest.approx((0.99, 1.5))
    assert len(one["usable"]["trials"]) == 2
    assert any("moves less than 0.02 rad or m: elbow" in text for text in one["advice"])
    assert any("no measured efforts" in text for text in one["advice"])
    assert one["missing"] == []


def test_show_and_replay_say_which_samples_are_doubtful(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    position = recording.series["state"].position
    assert position is not None
    position[70, 1] += 0.5
    position[80:, 0] = position[80, 0]
    (tmp_path / "arm.xml").write_text(ARM)
    model, log = str(tmp_path / "arm.xml"), as_csv(recording, tmp_path / "log.csv")
    assert cli.main(["show", model, str(log)]) == 0
    of_show = capsys.readouterr().out
    assert cli.main(["replay", model, str(log), "--out", str(tmp_path / "out.mcap")]) == 0
    of_replay = capsys.readouterr().out
    for line in (
        "doubtful (outlier), kept: elbow off the line of neighbours in 1 message at 0.7 s\n",
        f"doubtful (stuck), kept: shoulder stays at {position[80, 0]:.6g} rad while its command "
        "moves at 0.8 s\n",
    ):
        assert line in of_show
        assert line in of_replay


def test_show_lists_the_episodes_of_a_data_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = write_dataset(tmp_path / "set", [episode(0, 60), episode(1, 40)])
    said = output_of_show(dataset, capsys)
    assert "LeRobot data set, 2 episodes" in said
    assert "episode_000001: 0.78 s, usable" in said
    assert "no unit is declared" in said


@pytest.mark.parametrize("by_twin", [True, False])
def test_csv_headers_are_mapped_by_the_twin_or_an_option(
    recording: Recording, tmp_path: Path, by_twin: bool
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    path = as_csv(recording, tmp_path / "log.csv")
    heads, _, rows = path.read_text().partition("\n")
    mapping = {f"c{at}": meaning for at, meaning in enumerate(heads.split(","))}
    path.write_text(",".join(mapping) + "\n" + rows)
    columns = "".join(f"  {heading}: {meaning}\n" for heading, meaning in mapping.items())
    twin = "name: arm\nmodel: arm.xml\n" + (f"columns:\n{columns}" if by_twin else "")
    (tmp_path / "twin.yaml").write_text(twin)
    option = ",".join(f"{heading}={meaning}" for heading, meaning in mapping.items())
    words = [str(tmp_path / "twin.yaml"), str(path), "--out", str(tmp_path / "out.mcap")]
    words += [] if by_twin else ["--columns", option]
    assert cli.main(["replay", *words]) == 0
    state = read_recording(tmp_path / "out.mcap").series["state"]
    np.testing.assert_array_equal(state.stamp, recording.series["state"].stamp)


def test_the_next_command_reads_the_recording_as_this_one_did(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    renamed = [
        series(topic, JOINTS, TIME, position=one.position)
        for topic, one in zip(("/a/s", "/a/c"), recording.series.values(), strict=True)
    ]
    write_recording(tmp_path / "log.mcap", renamed)
    options = ["--topics", "state=/a/s,command=/a/c", "--command-between", "interpolated"]
    arguments = ["show", str(tmp_path / "arm.xml"), str(tmp_path / "log.mcap"), *options]
    assert cli.main(arguments) == 0
    expected = f"{tmp_path / 'log.mcap'} {' '.join(options)} ... --out diagnosis"
    assert expected in capsys.readouterr().out


@pytest.mark.parametrize("declared", [True, False])
def test_the_kind_of_unnamed_commands_is_noted_unless_it_is_declared(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], declared: bool
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    mode = "command_mode: position\n" if declared else ""
    (tmp_path / "twin.yaml").write_text(f"name: arm\nmodel: arm.xml\n{mode}")
    log = as_csv(recording, tmp_path / "log.csv")
    assert cli.main(["show", str(tmp_path / "twin.yaml"), str(log)]) == 0
    said = capsys.readouterr().out
    assert ("does not say whether it holds positions" in said) is not declared
    assert ("taken as position commands at shoulder, elbow, the model has" in said) is not declared
