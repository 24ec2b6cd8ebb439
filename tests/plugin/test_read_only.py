"""Read-only or full disks: verdicts are unaffected, each unsaved file is reported in one line."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


def _mount(*arguments: str) -> None:
    result = subprocess.run(["mount", *arguments], capture_output=True, text=True)
    if result.returncode != 0:
        pytest.skip(f"this process may not mount file systems: {result.stderr.strip()}")


@contextlib.contextmanager
def _read_only(folder: Path) -> Iterator[None]:
    """Mount ``folder`` read-only, for the superuser too."""
    _mount("--bind", str(folder), str(folder))
    try:
        _mount("-o", "remount,bind,ro", str(folder))
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextlib.contextmanager
def _full(folder: Path, spare_kib: int = 0) -> Iterator[None]:
    """Put ``folder`` on a separate file system with ``spare_kib`` KiB free."""
    copy = folder.with_name(f"{folder.name}-aside")
    shutil.copytree(folder, copy)
    _mount("-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder))
    try:
        shutil.copytree(copy, folder, dirs_exist_ok=True)
        with contextlib.suppress(OSError), (folder / "ballast").open("wb", 0) as ballast:
            while True:
                ballast.write(bytes(4096))
        with (folder / "ballast").open("r+b") as ballast:
            ballast.truncate(ballast.seek(0, 2) - spare_kib * 1024)
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def recorded_without_output(recorded):
    """A recorded twin without output files of earlier runs."""
    shutil.rmtree(recorded.root / ".twin", ignore_errors=True)
    return recorded


def test_on_a_read_only_checkout_goldens_pass_and_unsaved_files_are_reported(
    recorded_without_output,
) -> None:
    with _read_only(recorded_without_output.root):
        result = recorded_without_output.run_apart("-p", "no:cacheprovider")
    result.assert_outcomes(passed=2)
    folder = f"{recorded_without_output.root}/.twin"
    result.stdout.fnmatch_lines(
        [
            f"plots are not saved: {folder}/plots/golden/*: cannot be written: Read-only file sys*",
            f"the report is not saved: {folder}: cannot be written: Read-only file system",
        ]
    )
    assert "Traceback" not in result.stdout.str() + result.stderr.str()


def test_a_failure_on_a_read_only_checkout_is_fully_reported(recorded_without_output) -> None:
    recorded_without_output.edit("arm.xml", 'pos="0.25 0 0"', 'pos="0.26 0 0"')
    with _read_only(recorded_without_output.root):
        result = recorded_without_output.run_apart(
            "-p", "no:cacheprovider", "--twin-report", "/dev/null/x"
        )
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(
        ["golden/fk/home@mujoco: position of tcp* exceeded its tolerance of 0.0001 m by *"]
    )
    assert "plot  " not in result.stdout.str()


def test_a_release_on_a_read_only_checkout_is_refused_in_one_line(recorded_without_output) -> None:
    with _read_only(recorded_without_output.root):
        result = recorded_without_output.run_apart("-p", "no:cacheprovider", "--twin-release")
    result.assert_outcomes(passed=2)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        [
            "no release:",
            f"  {recorded_without_output.root}/releases: cannot be written: Read-only file system",
        ]
    )


def test_an_update_on_a_read_only_checkout_fails_in_one_line(recorded_without_output) -> None:
    recorded_without_output.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    with _read_only(recorded_without_output.root):
        result = recorded_without_output.run_apart("-p", "no:cacheprovider", "--twin-update")
    # The other golden is unchanged and needs no writing.
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(
        ["golden/mass/arm@mujoco: */golden/mass/arm.yaml: cannot be written: Read-only file system"]
    )


def test_on_a_full_disk_goldens_pass_and_a_failed_release_leaves_no_files(
    recorded_without_output,
) -> None:
    root = recorded_without_output.root
    with _full(root, spare_kib=8):
        result = recorded_without_output.run_apart("-p", "no:cacheprovider", "--twin-release")
        left = sorted(p.name for p in root.glob("releases/*")) + sorted(
            p.name for p in root.rglob(".twin-*")
        )
    result.assert_outcomes(passed=2)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        ["no release:", f"  {root}/*: cannot be written: No space left on device"]
    )
    assert left == []
    assert "Traceback" not in result.stdout.str() + result.stderr.str()
