"""Files that a spec names: recordings, a user's own code."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.checks.fields import spec_error
from pytest_twin.errors import PathError
from pytest_twin.formats.paths import Roots
from pytest_twin.golden import Golden
from pytest_twin.twin import Twin


def find_file(golden: Golden, field: str, reference: str, twin: Twin) -> Path:
    """The file that ``reference`` names: below the twin's folder, else below one of its roots.

    Paths in a spec are relative to the twin's folder, as those in ``twin.yaml`` are; the declared
    ``roots:`` are looked through in their order after it, so that a spec does not have to say
    where on this machine the recordings lie.

    Raises:
        PathError: no such file, or one outside these folders.
    """
    line = golden.lines.get(field)
    folders = (twin.root, *twin.roots.values())
    if not Path(reference).is_absolute():
        for folder in folders:
            candidate = folder / reference
            if candidate.exists():
                inside = Roots(twin.root, tuple(twin.roots.values()))
                return inside.resolve(str(candidate), at=golden.path, line=line, where=field)
    places = " or ".join(str(folder) for folder in folders)
    error = spec_error(
        golden, field, "no such file", value=reference, expected=f"a file below {places}"
    )
    raise PathError(
        error.problem,
        path=error.path,
        line=error.line,
        where=error.where,
        value=error.value,
        expected=error.expected,
    )
