"""Every command on a read-only or full disk: one line of error, exit status 2, no files."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from release_twins import MakeRelease
from test_stamp_command import write_mcap

from pytest_twin import cli
from pytest_twin.formats import temporary

pytestmark = pytest.mark.usefixtures("commands_in_process")

MODEL = """<mujoco><compiler angle="radian"/>
<worldbody><body name="arm"><joint name="elbow" axis="0 1 0" range="-1 1"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="1"/></body></worldbody>
<actuator><position joint="elbow" name="elbow" kp="10"/></actuator></mujoco>
"""
URDF = """<robot name="arm"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="2"/></joint></robot>
"""
COMMANDS = {
    "init": "init robot.urdf --out {disk}/twin",
    "intake": "intake supplier --out {disk}/asset",
    "audit": "audit robot.urdf --out {disk}",
    "realize": "realize robot.urdf --out {disk}",
    "replay": "replay model.xml moves.csv --out {disk}/predicted.mcap",
    "diagnose": "diagnose model.xml moves.csv --seconds 1 --out {disk}/diagnosis",
    "diagnose --fleet": "diagnose --fleet fleet.yaml --seconds 1 --out {disk}/fleet",
    "calibrate": "calibrate plan.yaml --out {disk}",
    "excite": "excite twin.yaml --out {disk}",
    "identify": "identify model.xml moves.csv --out {disk}/identified",
    "budget": "budget twin.yaml --out {disk}",
    "randomize": "randomize twin.yaml --out {disk}",
    "convert": "convert moves.csv --out {disk}/moves.mcap",
    "show": "show moves.csv --json {disk}/result.json",
    "effects": "effects --json {disk}/result.json",
    "rollback": "rollback --twin {disk}",
    "stamp": "stamp {disk}/moves.mcap --release {disk}/releases/0001",
}
"""Command -> its words. ``verify``, ``fresh``, ``shadow`` and ``completion`` write only what
``--json FILE`` and ``--promote`` name, by the same functions."""
NEED_A_RELEASE = ("rollback", "stamp")
WRITES_ONLY_AFTER_LONG_WORK = (
    "diagnose", "diagnose --fleet", "calibrate", "excite", "identify", "budget", "randomize",
)  # fmt: skip
"""Their files are written by the same function as those of ``audit``."""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with inputs of every command."""
    monkeypatch.chdir(tmp_path)
    temporary._swept.clear()
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "robot.urdf").write_text(URDF)
    (tmp_path / "twin.yaml").write_text("name: arm\nmodel: model.xml\n")
    (tmp_path / "plan.yaml").write_text("calibration: hand_eye\n")
    (tmp_path / "fleet.yaml").write_text(
        "robots: {arm: {model: model.xml, recordings: [moves.csv]}}\n"
    )
    rows = [f"{0.01 * i:.2f},{0.1 * (i % 7)},{0.1 * (i % 7) + 0.001}" for i in range(50)]
    (tmp_path / "moves.csv").write_text(
        "time,elbow.position,elbow.command\n" + "\n".join(rows) + "\n"
    )
    (tmp_path / "supplier").mkdir()
    shutil.copy(tmp_path / "robot.urdf", tmp_path / "supplier")
    (tmp_path / "disk").mkdir()
    return tmp_path


def _mount(*arguments: str) -> None:
    result = subprocess.run(["mount", *arguments], capture_output=True, text=True)
    if result.returncode != 0:
        pytest.skip(f"this process may not mount file systems: {result.stderr.strip()}")


@contextlib.contextmanager
def _small(folder: Path, *, full: bool) -> Iterator[None]:
    """Mount a small file system on a folder, full or read-only, with the folder's files."""
    copy = folder.with_name("copy")
    shutil.copytree(folder, copy)
    _mount("-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder))
    try:
        shutil.copytree(copy, folder, dirs_exist_ok=True)
        if full:
            with contextlib.suppress(OSError), (folder / "ballast").open("wb", 0) as ballast:
                while True:
                    ballast.write(bytes(4096))
        else:
            _mount("-o", "remount,ro", str(folder))
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def _names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


@pytest.mark.parametrize("kind", ["read-only", "full"])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_disk_that_cannot_be_written_gives_one_line_and_leaves_nothing(
    command: str, kind: str, files: Path, root: Path, make: MakeRelease,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if kind == "full" and command in WRITES_ONLY_AFTER_LONG_WORK:
        pytest.skip("its files are written by the same function as those of audit")
    disk = files / "disk"
    if command in NEED_A_RELEASE:
        make(datetime.now(UTC))
        (root / "arm.xml").write_text("today")
        write_mcap(root / "moves.mcap")
        disk = root
    words = COMMANDS[command].format(disk=disk).split()
    capsys.readouterr()
    with _small(disk, full=kind == "full"):
        before = _names(disk)
        status = cli.main(words)
        after = _names(disk)
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line]
    if command == "diagnose --fleet":
        lines = [line for line in captured.out.splitlines() if "disk/fleet" in line][:1] or lines
    reason = "Read-only file system" if kind == "read-only" else "No space left on device"
    assert status == 2, captured
    assert len(lines) == 1, captured
    assert reason in lines[0]
    assert str(disk) in lines[0]
    assert after == before


def test_a_full_standard_output_gives_one_line(files: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "pytest_twin.cli", "effects"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == "pytest-twin effects: No space left on device\n"
