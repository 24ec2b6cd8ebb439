"""Read the recording of a golden: a file, or one episode of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pytest_twin.checks.fields import spec_error
from pytest_twin.checks.files import find_file
from pytest_twin.checks.schemas import integer
from pytest_twin.golden import Golden
from pytest_twin.twin import Twin

if TYPE_CHECKING:
    from pytest_twin.formats.recording import Recording

EPISODE_SCHEMA: Mapping[str, Any] = integer(
    "Number of the episode in a data set with several, from 0.", minimum=0
)
_FIELD = "target.episode"


def recording_of(golden: Golden, twin: Twin) -> Recording:
    """Read the recording ``target.recording``, for a data set the episode ``target.episode``.

    Raises:
        PathError: the file or folder does not exist.
        SpecError: no episode is chosen among several, the episode does not exist, or an
            episode is chosen for a recording without episodes.
        TwinError: the recording cannot be read.
    """
    from pytest_twin.trial import recordings_at
    from pytest_twin.trial.roles import refuse_final

    reference = golden.target["recording"]
    path = find_file(golden, "target.recording", reference, twin)
    found = recordings_at(path, twin.topics, twin.recordings)
    for one in found:
        refuse_final(one.metadata, path, "a golden")
    episode: int | None = golden.target.get("episode")
    last = len(found) - 1
    if episode is None:
        if last == 0:
            return found[0]
        raise spec_error(
            golden, "target.recording", f"a data set of {len(found)} episodes", value=reference,
            expected=f"{_FIELD}: N with N from 0 to {last}",
        )  # fmt: skip
    if last == 0:
        raise spec_error(
            golden, _FIELD, f"{path.name} has only one episode", value=episode,
            expected=f"no {_FIELD}",
        )  # fmt: skip
    if episode > last:
        raise spec_error(
            golden, _FIELD, f"{path.name} has {len(found)} episodes", value=episode,
            expected=f"0 to {last}",
        )  # fmt: skip
    return found[episode]
