"""Find and load the model that a user names: a file, a twin, or the folder of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pytest_twin.errors import SpecError
from pytest_twin.formats import results
from pytest_twin.formats.recording import TOPICS
from pytest_twin.recording_options import NO_OPTIONS, Base, RecordingOptions
from pytest_twin.twin import FILE_NAME, Twin, load_twin, model_suffixes

if TYPE_CHECKING:
    from pytest_twin.diagnosis.patched.model import PatchedModel
    from pytest_twin.realization import Realization

# In a folder of a diagnosis, the first of these that exists.
_IN_FOLDER = (f"realization/{FILE_NAME}", "realization/model.xml", FILE_NAME)


def find_model(given: Path) -> Path:
    """Return the model or ``twin.yaml`` for MODEL on a command line.

    Raises:
        SpecError: a folder with neither, or a file of a different kind.
    """
    if given.is_dir():
        results.finish(given)
        for name in _IN_FOLDER:
            if (given / name).is_file():
                return (given / name).resolve()
        raise SpecError("no model in this folder", path=given, expected=" or ".join(_IN_FOLDER))
    if not given.exists():
        raise SpecError("no such model", path=given, expected="a file or a folder")
    if given.suffix.lower() not in (*model_suffixes(), ".yaml", ".yml"):
        raise SpecError(
            "not a model that can be replayed",
            path=given,
            expected="MJCF (.xml, .mjcf), URDF (.urdf), twin.yaml, or the folder of a diagnosis",
        )
    return given.resolve()


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """A model with what its twin states about recordings.

    Attributes:
        realization: the realization, with its twin if it has one.
        topics: role -> topic.
        options: the twin's options for reading recordings.
        patched: effects of a diagnosis that are stepped together with the model, or None.
    """

    realization: Realization
    topics: Mapping[str, str]
    options: RecordingOptions
    patched: PatchedModel | None


def load_model(path: str | Path, base: Base | None = None) -> LoadedModel:
    """Load a model in this process.

    >>> model = load_model("axis.xml")
    >>> model.realization.joints
    ('slide',)

    Args:
        path: MJCF or URDF file, ``twin.yaml``, or the folder that ``pytest-twin diagnose`` wrote.
        base: what holds a floating base; overrides the twin.

    Raises:
        TwinError: there is no such model, or it cannot be loaded.
    """
    # The parent process of a command needs find_model alone.
    from pytest_twin.diagnosis.patched.model import read_patched_model
    from pytest_twin.realization import load
    from pytest_twin.realization.record_inputs import with_stale_records

    file = find_model(Path(path))
    twin: Twin | None = None
    name = "mujoco"
    if file.suffix.lower() in (".yaml", ".yml"):
        twin = load_twin(file)
        first = twin.first_realization
        name, file = first.name, first.file
    realization = with_stale_records(load(file, twin=twin, name=name, base=base))
    topics = dict(TOPICS if twin is None else twin.topics)
    options = NO_OPTIONS if twin is None else twin.recordings
    return LoadedModel(realization, topics, options, read_patched_model(realization))
