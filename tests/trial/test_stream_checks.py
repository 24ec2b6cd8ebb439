"""Positions that are copies of commands, in another unit, or zeros: refused or said by all."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")
ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/>
<default><joint damping="0.4" armature="0.01"/></default>
<worldbody><body pos="0 0 1"><joint name="hip" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
  <body pos="0 0 -.3"><joint name="knee" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".6"/></body></body></worldbody>
<actuator><position name="hip" joint="hip" kp="60" kv="2"/>
  <position name="knee" joint="knee" kp="30" kv="1"/></actuator></mujoco>"""
RATE = 100.0
"""Hz of states and commands."""
COUNT = 600
Table = np.ndarray


def commanded() -> Table:
    """(n, 2) smooth commands, rad, of another course at each joint."""
    time = np.arange(COUNT) / RATE
    course = 0.6 + 0.4 * np.sin(2.1 * time) + 0.05 * np.sin(11.0 * time)
    return np.column_stack([course, -0.9 + 0.3 * np.cos(3.3 * time + 0.4)])


def measured(command: Table) -> Table:
    """(n, 2) noisy positions of the arm under the commands, rad."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = command[0]
    rows = []
    for target in command:
        rows.append(data.qpos.copy())
        data.ctrl[:] = target
        mujoco.mj_step(model, data, 5)
    noise = np.random.default_rng(7).standard_normal((len(rows), 2))
    return np.array(rows) + 2e-4 * noise


def write(folder: Path, position: Table, command: Table, head: str = "", every: int = 1) -> Path:
    """A CSV log; commands are filled at every k-th row only."""
    (folder / "arm.xml").write_text(ARM)
    lines = ["time,hip.position,knee.position," + (head or "hip.command,knee.command")]
    for k, (seen, sent) in enumerate(zip(position, command, strict=True)):
        cells = [f"{v:.9g}" for v in seen]
        cells += [f"{v:.9g}" for v in sent] if k % every == 0 else ["", ""]
        lines.append(",".join([f"{k / RATE:.4f}", *cells]))
    path = folder / "log.csv"
    path.write_text("\n".join(lines))
    return path


def shown(log: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.main(["show", str(log.parent / "arm.xml"), str(log)]) == 0
    return capsys.readouterr().out


def refusal(command: str, log: Path, capsys: pytest.CaptureFixture[str]) -> str:
    out = log.parent / "out.mcap"
    code = cli.main([command, str(log.parent / "arm.xml"), str(log), "--out", str(out)])
    assert code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize("late", [0, 1, 3])
@pytest.mark.parametrize("every", [1, 4])
def test_copies_of_commands_are_refused_by_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], late: int, every: int
) -> None:
    command = commanded()
    sent = command[np.arange(COUNT) // every * every]
    copies = sent[np.maximum(np.arange(COUNT) - late * every, 0)]
    log = write(tmp_path, copies, command, every=every)
    said = shown(log, capsys)
    assert "positions of hip, knee are copies of their commands, so that nothing is" in said
    assert "cannot use this recording" in said
    when = "at the same time" if not late else f"{late} command{'s' * (late > 1)} late"
    for name in ("replay", "diagnose", "identify"):
        error = refusal(name, log, capsys)
        assert when in error
        assert "expected measured positions: encoders, not the setpoints" in error


def test_copies_made_by_interpolation_and_by_steps_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    at, sent = np.arange(COUNT), np.arange(0, COUNT, 5)
    between = np.column_stack([np.interp(at, sent, c[sent]) for c in command.T])
    between[sent[-1] :] = command[sent[-1]]
    assert "are copies" in shown(write(tmp_path, between, command, every=5), capsys)
    steps = np.column_stack([0.5 * (at // 100 % 3), -0.4 * (at // 150 % 2)]) + 0.1
    assert "are copies" in shown(write(tmp_path, steps, steps), capsys)


def test_one_copied_joint_is_said_and_not_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    position[:, 1] = command[:, 1]
    log = write(tmp_path, position, command)
    said = shown(log, capsys)
    assert "positions of knee are copies of their commands (at the same time)" in said
    out = tmp_path / "found"
    cli.main(["diagnose", str(tmp_path / "arm.xml"), str(log), "--seconds", "5", "--out", str(out)])
    assert "knee" not in json.loads((out / "diagnosis.json").read_text())["held_out"]
    assert "its encoder copies its command" in (out / "report.html").read_text()


def test_measured_positions_and_coarse_slow_encoders_are_no_copies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    assert "copies" not in shown(write(tmp_path, measured(command), command), capsys)
    count = 2.0 * np.pi / 4096
    slow = count * np.round(np.linspace(0.0, 0.3, COUNT)[:, None] * [1.0, -1.0] / count)
    assert "copies" not in shown(write(tmp_path, slow, slow), capsys)


@pytest.mark.parametrize(
    ("of_position", "of_command", "words"),
    [
        (1.0, 180.0 / np.pi, "as if positions were in rad and commands in degrees (ratio 0.01745)"),
        (180.0 / np.pi, 1.0, "as if positions were in degrees and commands in rad (ratio 57.3)"),
        (1.0, 4096 / (2 * np.pi), "as if commands were in encoder counts"),
    ],
)
def test_another_unit_of_commands_or_positions_is_refused_by_every_command(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    of_position: float,
    of_command: float,
    words: str,
) -> None:
    command = 0.1 * commanded()
    log = write(tmp_path, of_position * measured(command), of_command * command)
    assert words in shown(log, capsys)
    for name in ("replay", "diagnose", "identify"):
        error = refusal(name, log, capsys)
        assert words in error
        assert "a heading may state the unit of one of them, such as 'hip.command [deg]'" in error


def test_the_heading_with_the_unit_is_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    head = "hip.command [deg],knee.command [deg]"
    log = write(tmp_path, measured(command), np.degrees(command), head)
    assert "can use 5.99 s" in shown(log, capsys)


def test_zeros_of_a_lost_bus_are_left_out_with_rows_and_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    position[200:229] = 0.0
    log = write(tmp_path, position, command)
    words = (
        "left out, positions of hip, knee are exactly zero between others far from zero in 29 "
        "messages: from 2 to 2.28 s (messages 200 to 228)"
    )
    assert words in shown(log, capsys)
    out = tmp_path / "predicted.mcap"
    assert cli.main(["replay", str(tmp_path / "arm.xml"), str(log), "--out", str(out)]) == 0
    result = json.loads(out.with_suffix(".json").read_text())
    assert result["samples"] == COUNT - 29
    assert result["joints"]["hip"]["rms"] < 4e-4
    assert any(words in note for note in result["notes"])


def test_zeros_of_one_motor_and_before_the_first_reading_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    position[300:310, 1] = 0.0
    assert "positions of knee are exactly zero" in shown(write(tmp_path, position, command), capsys)
    position = measured(command)
    position[:8] = 0.0
    assert "(messages 0 to 7)" in shown(write(tmp_path, position, command), capsys)


def test_many_zeros_are_refused_and_a_joint_at_zero_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    position[200:400] = 0.0
    error = refusal("replay", write(tmp_path, position, command), capsys)
    assert "200 of 600 messages, first at 2 s" in error
    home = command * (np.arange(COUNT) % 300 < 150)[:, None]
    at_home = measured(home)
    at_home[np.abs(at_home) < 0.01] = 0.0
    assert "exactly zero" not in shown(write(tmp_path, at_home, home), capsys)


def test_convert_writes_every_number_and_says_the_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    position[200:229] = 0.0
    for seen, sent, words in (
        (command, command, "are copies of their commands"),
        (position, command, "are exactly zero between others far from zero in 29 messages"),
        (measured(command), np.degrees(command), "as if positions were in rad and commands in deg"),
    ):
        log = write(tmp_path, seen, sent)
        arguments = ["--command-mode", "position", "--out", str(tmp_path / "log.mcap")]
        assert cli.main(["convert", str(log), *arguments]) == 0
        said = capsys.readouterr().out
        assert words in said
        assert f"{COUNT} states" in said


def with_times(log: Path, time: Table) -> Path:
    head, *rows = log.read_text().splitlines()
    pairs = zip(time, rows, strict=True)
    changed = [f"{t:.4f},{row.partition(',')[2]}" for t, row in pairs]
    log.write_text("\n".join([head, *changed]))
    return log


def test_times_that_run_backwards_are_refused_by_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    log = write(tmp_path, measured(command), command)
    with_times(log, np.arange(COUNT)[::-1] / RATE)
    words = "the times run backwards (got 'earlier than the one before in 599 of 599 messages'"
    assert words in shown(log, capsys)
    for name in ("replay", "diagnose", "identify"):
        assert words in refusal(name, log, capsys)


def test_messages_out_of_order_are_sorted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    log = write(tmp_path, measured(command), command)
    time = np.arange(COUNT) / RATE
    time[100:102] = time[[101, 100]]
    assert "can use 5.99 s" in shown(with_times(log, time), capsys)


def test_a_recording_that_begins_in_motion_without_velocity_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = commanded()
    position = measured(command)
    cut = slice(150, None)

    def said(log: Path) -> str:
        out = str(tmp_path / "p.mcap")
        assert cli.main(["replay", str(tmp_path / "arm.xml"), str(log), "--out", out]) == 0
        return capsys.readouterr().out

    assert "begins in motion" not in said(write(tmp_path, position, command))
    assert "log.csv begins in motion (" in said(write(tmp_path, position[cut], command[cut]))
