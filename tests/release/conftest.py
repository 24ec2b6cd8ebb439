"""A temporary twin and user configuration for each test of releases."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest
from release_twins import NOW, MakeRelease, html, make_draft, make_twin

from pytest_twin import release


@pytest.fixture(autouse=True)
def user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put the user's configuration and state into the test's temporary folder."""
    home = tmp_path / "user"
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "state"))
    monkeypatch.delenv("TWIN_SIGNING_KEY", raising=False)
    return home


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make_twin(tmp_path / "arm")


@pytest.fixture
def make(root: Path) -> MakeRelease:
    """Write the next release of the twin."""

    def write(now: datetime = NOW) -> release.Release:
        signer, _ = release.signer(root)
        written, _ = release.write(root, make_draft(root), signer, html, now=now)
        return written

    return write
