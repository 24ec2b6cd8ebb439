"""Fixture ``twin_release``: gives a user's test the newest release of its twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

_KNOWN: pytest.StashKey[dict[Path, TwinRelease]] = pytest.StashKey()


@dataclass(frozen=True, slots=True)
class TwinRelease:
    """The newest release of a twin, after verification.

    Attributes:
        number: number of the release.
        ids: the signed IDs of asset, calibration, fit, controller and payload.
    """

    twin: str
    number: int
    ids: Mapping[str, Any]
    root: Path
    folder: Path

    def file(self, name: str) -> Path:
        """Path of the released copy of a file, such as ``file("arm.xml")``.

        Args:
            name: path relative to the twin's folder.

        Raises:
            pytest.fail.Exception: the release does not contain it.
        """
        path = self.folder / "files" / name
        if not path.resolve().is_relative_to(self.folder) or not path.is_file():
            pytest.fail(f"release {self.number} of {self.twin!r} contains no file {name!r}")
        return path

    def require_stamp(self, dataset: Path | str) -> None:
        """Fail the test unless a data set or policy has a valid stamp of this release.

        Raises:
            pytest.fail.Exception: with the reason.
        """
        from pytest_twin.errors import TwinError
        from pytest_twin.release import stamps

        path = Path(dataset)
        try:
            found = stamps.read(path)
            verdicts = stamps.judge(found, stamps.keys_of(path, found, self.root / "keys"))
        except TwinError as error:
            pytest.fail(str(error))
        for file, verdict in verdicts.items():
            if verdict.problems:
                pytest.fail(f"{file}: its stamp does not hold: {verdict.problems[0]}")
            if verdict.release is not None and verdict.release.number != self.number:
                pytest.fail(
                    f"{file}: made with release {verdict.release.number} of {self.twin!r}, and "
                    f"release {self.number} is the newest; pytest-twin fresh says what changed"
                )


@pytest.fixture(scope="module")
def twin_release(request: pytest.FixtureRequest) -> TwinRelease:
    """The newest release of the twin at or above the test's file.

    The test fails if there is no twin, no release, or a release that fails verification.
    """
    from pytest_twin.twin import find_twin

    file = find_twin(request.path.parent)
    if file is None:
        pytest.fail("twin_release: no twin.yaml at or above the folder of this test")
    known = request.config.stash.setdefault(_KNOWN, {})
    if file not in known:
        known[file] = _newest(file.parent)
    return known[file]


def _newest(root: Path) -> TwinRelease:
    from pytest_twin import release
    from pytest_twin.errors import TwinError

    folder = release.newest(root)
    if folder is None:
        pytest.fail(f"twin_release: {root} has no release; pytest --twin-release writes one")
    try:
        verdict = release.check(folder)
    except TwinError as error:
        pytest.fail(f"twin_release: {error}")
    if not verdict.holds or verdict.release is None:
        reasons = "; ".join(problem.text for problem in verdict.problems)
        pytest.fail(f"twin_release: {folder} does not hold: {reasons}")
    found = verdict.release
    return TwinRelease(found.twin, found.number, found.ids, root.resolve(), folder.resolve())
