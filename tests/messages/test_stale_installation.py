"""An installation with outdated entry points asks the user to reinstall the package."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

from pytest_twin import checks, effects, installed
from pytest_twin.errors import SpecError
from pytest_twin.formats import recordings

THEIRS = EntryPoint("theirs", "pathlib:Path", "")


@pytest.mark.parametrize("registered", [(), (THEIRS,)], ids=["nothing", "another package"])
@pytest.mark.parametrize(
    ("module", "kept", "ask", "group"),
    [
        (
            recordings,
            (recordings.readers,),
            lambda file: recordings.read_recordings(file),
            "pytest_twin.recordings",
        ),
        (
            checks,
            (installed.entry_points_by_name, checks.check_of),
            lambda file: checks.check_of("fk"),
            "pytest_twin.checks",
        ),
        (effects, (effects.catalogue,), lambda file: effects.catalogue(), "pytest_twin.effects"),
    ],
    ids=["recordings", "checks", "effects"],
)
def test_an_outdated_installation_is_reported_with_the_command_to_run(
    module: ModuleType,
    kept: tuple[Callable[..., object], ...],
    ask: Callable[[Path], object],
    group: str,
    registered: tuple[EntryPoint, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "log.csv"
    file.write_text("time,a.position\n0.0,1\n")
    if module is recordings:
        monkeypatch.setattr(recordings, "load_plugin", lambda point, noun: NoReader())
    asked = installed if module is checks else module
    monkeypatch.setattr(asked, "entry_points", lambda group: registered)
    clear_caches(kept)
    try:
        with pytest.raises(SpecError, match="installation of pytest-twin is stale") as caught:
            ask(file)
    finally:
        clear_caches(kept)
    assert caught.value.where == group
    assert "reinstall pytest-twin: pip install" in str(caught.value)


class NoReader:
    """A reader of another package that does not support the file."""

    def reads(self, path: Path) -> bool:
        return False


def clear_caches(kept: tuple[Callable[..., object], ...]) -> None:
    for function in kept:
        function.cache_clear()  # type: ignore[attr-defined]


def test_an_up_to_date_installation_refuses_files_that_are_not_recordings(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("hello")
    with pytest.raises(recordings.FormatError, match="no recording that can be read"):
        recordings.read_recordings(file)
