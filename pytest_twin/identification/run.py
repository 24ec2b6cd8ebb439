"""One identification from its files to the folder that it leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError, SpecError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.identification.effort.identify import identify_effort
from pytest_twin.identification.fit_patches import patches_of
from pytest_twin.identification.records import effort_document
from pytest_twin.identification.roles import read_by_role
from pytest_twin.identification.write import write_fitted
from pytest_twin.realization import Realization, load
from pytest_twin.realization.files.search import SearchFolders
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS, Twin, load_twin

REALIZATION = "realization"


def identify_files(
    model: str,
    recordings: Sequence[str],
    held_out: Sequence[str],
    out: str,
    name: str,
    topics: Mapping[str, str],
    options: Mapping[str, Any],
    packages: Mapping[str, str] | None = None,
    roots: Sequence[str] = (),
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Load, identify, write the fitted model; runs in the child process.

    Args:
        model: MJCF, URDF or ``twin.yaml``.
        recordings, held_out: files and folders.
        out: empty folder; gets ``realization/``.
        name: id of the record.
        topics: role -> topic, before those of the twin.
        options: how recordings are read, before what the twin says.
        packages, roots: where the model's files lie.
        progress: told the fraction done.

    Returns:
        The content of ``identification.json``.

    Raises:
        TwinError: input that cannot be used.
    """
    realization, notes = _load(Path(model), SearchFolders.of(roots, packages))
    twin = realization.twin
    chosen = RecordingOptions.from_json(options).over(
        NO_OPTIONS if twin is None else twin.recordings
    )
    signals = NO_SIGNALS if twin is None else twin.signals
    paths = [Path(one) for one in recordings]
    tested = [Path(one) for one in held_out]
    progress(0.1)
    measured = read_by_role(
        paths, tested, realization,
        {**(DEFAULT_TOPICS if twin is None else twin.topics), **topics}, chosen, signals,
    )  # fmt: skip
    progress(0.3)
    result = identify_effort(realization, measured, signals)
    progress(0.8)
    document = effort_document(result, result.stages)
    document["notes"] = [*notes, *measured.notes, *document["notes"]]
    document["identification"] = name
    document["trials"] = {
        "fit": list(dict.fromkeys(one.path.name for one in measured.fit)),
        "held_out": list(dict.fromkeys(one.path.name for one in measured.held_out)),
    }
    document["fit"] = patches_of(realization, result)
    document["inputs"] = {
        path.name: {"sha256": file_sha256(path)}
        for path in (Path(model), realization.path, *paths, *tested)
        if path.is_file()
    }
    folder = Path(out) / REALIZATION
    folder.mkdir()
    write_fitted(folder, realization, document["fit"])
    document["realization"] = f"{REALIZATION}/"
    progress(1.0)
    return document


def _load(path: Path, search: SearchFolders) -> tuple[Realization, list[str]]:
    """The model with its twin; without shapes where meshes of a URDF are missing."""
    twin: Twin | None = None
    name = "mujoco"
    if path.suffix.lower() in (".yaml", ".yml"):
        twin = load_twin(path)
        if not twin.realizations:
            raise SpecError(
                "this twin has no model",
                path=path,
                where="model",
                expected="a path to a robot description, such as 'model: robot.urdf'",
            )
        name, reference = next(iter(twin.realizations.items()))
        path = reference.file
    try:
        return load(path, twin=twin, name=name, search=search, accept_invalid_inertia=True), []
    except PathError as error:
        if path.suffix.lower() != ".urdf":
            raise
        loaded = load(
            path, twin=twin, name=name, search=search, accept_invalid_inertia=True, shapes=False
        )
        return loaded, [
            f"the model is used without its shapes, which no effort depends on: {error}"
        ]
