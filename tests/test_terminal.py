"""Progress and colour on a terminal, in a log file and without colour."""

from __future__ import annotations

import io
import time
from contextlib import redirect_stderr, redirect_stdout

import pytest

from pytest_twin.commands import progress
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show, show_error
from pytest_twin.report import progress_log

TEXT = "X inertia.negative: a mass below zero\nExplained: nothing is left\nnote: one recording"


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return Terminal()


def test_on_a_terminal_the_same_text_is_coloured(terminal: Terminal) -> None:
    with redirect_stdout(terminal):
        show(TEXT)
    said = terminal.getvalue()
    assert "\x1b[1;31mX inertia.negative" in said
    assert "\x1b[1;32mExplained" in said


def test_the_variable_no_color_disables_colour(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    with redirect_stdout(terminal):
        show("note: one recording")
    assert terminal.getvalue() == "note: one recording\n"


def test_text_to_a_pipe_is_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    show(TEXT)
    assert capsys.readouterr().out == TEXT + "\n"


def test_brackets_in_the_text_are_not_interpreted_as_markup(terminal: Terminal) -> None:
    with redirect_stderr(terminal):
        show_error("pytest-twin audit", "link '[bold]wrist[/bold]': no mass")
    assert "link '[bold]wrist[/bold]': no mass" in terminal.getvalue()


def test_a_terminal_shows_stage_fraction_and_time_left(terminal: Terminal) -> None:
    stages = ((0.0, "reading"), (0.5, "searching"))
    with redirect_stderr(terminal), Progress("diagnosing", stages) as progress:
        progress(0.25)
        progress(0.75)
    said = terminal.getvalue()
    assert "diagnosing: searching" in said
    assert "75%" in said
    assert "left" in said


def test_a_log_file_gets_a_plain_progress_line_each_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_LOOK_SECONDS", 0.01)
    monkeypatch.setattr(progress_log, "_INTERVAL_SECONDS", 0.1)
    with Progress("choosing goldens") as shown:
        shown.begin("recording goldens")
        shown(0.5)
        time.sleep(0.35)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) in (1, 2, 3)
    assert set(lines) == {"recording goldens  50 % after 0 min, about 1 min left"}
