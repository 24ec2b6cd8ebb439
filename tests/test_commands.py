"""The door of ``pytest-twin``: every command is listed, one that is named is alone loaded."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pytest_twin import cli

LOADED = """
import sys
from pytest_twin import cli
try:
    cli.main([sys.argv[1], "--help"])
except SystemExit as end:
    assert end.code == 0
loaded = {name.removeprefix("pytest_twin.commands.") for name in sys.modules}
print("\\n" + " ".join(loaded & set(cli.COMMANDS)))
"""


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert all(f"    {name} " in said for name in cli.COMMANDS)


def test_what_is_no_command_is_answered_with_those_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["diagnoze"])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "diagnoze" in said
    assert all(name in said for name in cli.COMMANDS)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_command_loads_no_other_but_what_it_builds_on(name: str) -> None:
    """Imports of all take a second, before every one of a thousand short commands."""
    run = subprocess.run(
        [sys.executable, "-c", LOADED, name], capture_output=True, text=True, check=True
    )
    loaded = set(run.stdout.splitlines()[-1].split())
    assert loaded == {name, *(["replay"] if name == "diagnose" else [])}
