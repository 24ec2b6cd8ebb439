"""--twin-confine: goldens read only the twin and Python, and write only a scratch folder."""

from __future__ import annotations

import errno
import socket
import sys
import tempfile
from pathlib import Path

import pytest
import yaml

from pytest_twin.realization import confinement

needs_landlock = pytest.mark.skipif(
    confinement.why_not_confined() is not None, reason=str(confinement.why_not_confined())
)

TRY = """\
def tried(action):
    try:
        action()
    except OSError as error:
        return error.errno
    return 0
return {'reach': tried(lambda: ACTION)}
"""


def errno_of(folder, action: str, *flags: str) -> float:
    """The errno of an action in a golden's function, 0 if it is permitted."""
    folder.task("probe", TRY.replace("ACTION", action))
    assert folder.run("--twin-update", "-k", "probe", *flags).ret == 0
    return recorded_reach(folder)


def recorded_reach(folder) -> float:
    """The recorded output of the golden ``task/probe``."""
    return yaml.safe_load((folder.root / "golden/task/probe.yaml").read_text())["expected"]["reach"]


@needs_landlock
def test_goldens_pass_under_confinement(recorded) -> None:
    recorded.task(
        "mean", "import numpy, scipy.linalg\nreturn {'reach': float(numpy.ones(3).sum())}"
    )
    assert recorded.run("--twin-update", "--twin-confine").ret == 0
    recorded.run("--twin-all", "--twin-confine").assert_outcomes(passed=3)


@needs_landlock
def test_confinement_denies_reading_private_files(recorded) -> None:
    secret = recorded.pytester.path / "home" / ".ssh" / "id_ed25519"
    secret.parent.mkdir(parents=True)
    secret.write_text("private")
    action = f"open({str(secret)!r}).close()"
    assert errno_of(recorded, action) == 0
    assert errno_of(recorded, action, "--twin-confine") == errno.EACCES


@needs_landlock
@pytest.mark.parametrize("place", ["arm.xml", "new.txt", "golden/fk/home.yaml", "../beside.txt"])
def test_a_confined_golden_cannot_write_in_or_beside_its_twin(recorded, place: str) -> None:
    path = recorded.root / place
    before = path.read_bytes() if path.exists() else None
    assert (
        errno_of(recorded, f"open({str(path)!r}, 'a').write('x')", "--twin-confine") == errno.EACCES
    )
    assert (path.read_bytes() if path.exists() else None) == before


@needs_landlock
def test_a_confined_golden_cannot_delete_or_rename_files(recorded) -> None:
    path = recorded.root / "arm.xml"
    name = str(path)
    for action in (f"os.unlink({name!r})", f"os.rename({name!r}, {name + '-moved'!r})"):
        asked = f"__import__('os').{action.removeprefix('os.')}"
        assert errno_of(recorded, asked, "--twin-confine") == errno.EACCES
    assert path.exists()


@needs_landlock
def test_a_confined_golden_has_a_scratch_folder_that_is_deleted_after_the_run(recorded) -> None:
    note = "__import__('tempfile').mkstemp('.kept')[1]"
    assert errno_of(recorded, note, "--twin-confine") == 0
    assert list(Path(tempfile.gettempdir()).glob("twin-*/*.kept")) == []


@needs_landlock
def test_a_program_that_a_confined_golden_starts_is_confined_too(recorded) -> None:
    target = recorded.pytester.path / "beside.txt"
    action = f"__import__('os').system('echo x > {target}')"
    assert errno_of(recorded, action, "--twin-confine") == 0
    assert not target.exists()


@needs_landlock
def test_a_confined_golden_cannot_open_network_connections(recorded) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        action = f"__import__('socket').create_connection({server.getsockname()!r}, 5).close()"
        assert errno_of(recorded, action) == 0
        assert errno_of(recorded, action, "--twin-confine") == errno.EACCES


@needs_landlock
def test_a_confined_golden_cannot_read_tokens_in_environment_variables(
    recorded, monkeypatch
) -> None:
    monkeypatch.setenv("CLOUD_TOKEN", "secret")
    recorded.task("probe", "import os\nreturn {'reach': float('CLOUD_TOKEN' in os.environ)}")
    recorded.run("--twin-update", "-k", "probe")
    assert recorded_reach(recorded) == 1
    recorded.run("--twin-update", "-k", "probe", "--twin-confine")
    assert recorded_reach(recorded) == 0


def test_no_golden_runs_if_confinement_is_not_possible(recorded, monkeypatch) -> None:
    monkeypatch.setattr(confinement, "why_not_confined", lambda: "no Landlock here")
    result = recorded.run("--twin-confine")
    assert result.ret == pytest.ExitCode.INTERRUPTED
    assert "--twin-confine: no Landlock here" in result.stdout.lines
    assert "passed" not in result.parseoutcomes()
    result = recorded.run("--twin-confine", "--twin-release")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "ERROR: --twin-confine: no Landlock here" in result.stderr.lines
    assert recorded.releases == []


def test_a_missing_package_is_named_with_its_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "landlock", None)
    assert confinement.why_not_confined() == (
        "confinement needs the package landlock: pip install 'pytest-twin[confine]'"
    )


def test_on_other_systems_the_message_says_that_confinement_needs_linux(monkeypatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    assert (
        confinement.why_not_confined()
        == "confinement needs Linux; run without it, or in a container"
    )
