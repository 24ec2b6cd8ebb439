"""Find the files of a spec: recordings and user code."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import PathError
from pytest_twin.formats.paths import Roots
from pytest_twin.golden import Golden
from pytest_twin.twin import Twin


def find_file(golden: Golden, field: str, reference: str, twin: Twin) -> Path:
    """Find ``reference`` below the twin's folder, or else below one of its roots.

    Paths in a spec are relative to the twin's folder, as in ``twin.yaml``. The declared ``roots:``
    are searched next, in their order, so that specs do not depend on the machine.

    Raises:
        PathError: the file does not exist, or is outside these folders.
    """
    place = field
    while place not in golden.lines and "." in place:
        place = place.rpartition(".")[0]
    return _find(reference, twin, at=golden.path, line=golden.lines.get(place), where=field)


def find_recording(reference: str, twin: Twin) -> Path:
    """Find a recording in the folders that :func:`find_file` searches.

    Raises:
        PathError: as :func:`find_file`.
    """
    return _find(reference, twin, at=twin.path, line=None, where=None)


def _find(reference: str, twin: Twin, *, at: Path, line: int | None, where: str | None) -> Path:
    folders = (twin.root, *twin.roots.values())
    if not Path(reference).is_absolute():
        for folder in folders:
            candidate = folder / reference
            if candidate.exists():
                inside = Roots(twin.root, tuple(twin.roots.values()))
                return inside.resolve(
                    str(candidate), at=at, line=line, where=where, folder=candidate.is_dir()
                )
    places = " or ".join(str(folder) for folder in folders)
    raise PathError(
        "no such file",
        path=at,
        line=line,
        where=where,
        value=reference,
        expected=f"a file or folder below {places}",
    )
