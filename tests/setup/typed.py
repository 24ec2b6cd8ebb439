"""Commands as a person types them in a twin's folder."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from in_process import forked_pytest

from pytest_twin import cli

BIN = Path(sys.executable).parent


def run_apart(*command: str, cwd: Path, state: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a new process; ``state`` holds the user's configuration."""
    return subprocess.run(
        [str(BIN / command[0]), *command[1:]],
        cwd=cwd,
        env={**os.environ, **_folders(state)},
        capture_output=True,
        text=True,
        timeout=600,
    )


def run(*command: str, cwd: Path, state: Path) -> subprocess.CompletedProcess[str]:
    """Run ``pytest-twin`` in this process and ``pytest`` in a fork, which saves their start.

    With the fixture ``commands_in_process`` the children of ``pytest-twin`` are saved as well.
    """
    if command[0] == "pytest":
        return forked_pytest(*command[1:], cwd=cwd, env={**os.environ, **_folders(state)})
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.chdir(cwd)
        for name, folder in _folders(state).items():
            patch.setenv(name, folder)
        try:
            status = cli.main(command[1:])
        except SystemExit as refused:  # by the parser
            status = int(refused.code or 0)
    return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())


def _folders(state: Path) -> dict[str, str]:
    return {"XDG_CONFIG_HOME": str(state / "config"), "XDG_STATE_HOME": str(state / "state")}
