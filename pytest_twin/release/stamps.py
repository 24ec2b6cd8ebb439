"""Write stamps into data sets, read them, and verify them with trusted keys."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from securesystemslib.signer import Key

from pytest_twin.errors import PathError, ReleaseError, TwinError
from pytest_twin.formats.stamps import Carrier
from pytest_twin.formats.stamps.mcap import McapStamp
from pytest_twin.release import accepted_releases, stamp
from pytest_twin.release import folder as folders
from pytest_twin.release import keys as trusted_keys
from pytest_twin.release.data_joints import DataJoints, compare_joints
from pytest_twin.release.restore import read_authentic
from pytest_twin.release.stamp import Stamp, StampVerdict
from pytest_twin.release.stamp_sandbox import carriers_in_child
from pytest_twin.twin import find_twin
from pytest_twin.words import list_names

_SERIES = frozenset("0123456789abcdef")


@dataclass(frozen=True, slots=True)
class StampedFile:
    """A file that can contain a stamp.

    Attributes:
        stamp: its stamp, None if it has none or it cannot be read.
        problem: why the stamp cannot be read.
        undeclared: ``controller`` and ``payload`` that the file's own metadata name and the release
            does not declare, so that the stamp cannot name them.
        target: folder behind the link that the data set was when it was stamped, else None.
    """

    carrier: Carrier
    stamp: Stamp | None
    problem: str = ""
    undeclared: Mapping[str, str] = field(default_factory=dict)
    joints: DataJoints | None = None
    target: Path | None = None


def put(
    dataset: Path,
    release_folder: Path,
    *,
    payload: str | None = None,
    controller: str | None = None,
    joints: Mapping[str, str] | None = stamp.NO_MAPPING,
    now: datetime | None = None,
) -> list[StampedFile]:
    """Stamp all files of a data set, or a policy, with a release.

    All files are read before the first is written; each is replaced in one step.

    Args:
        dataset: file or folder.
        release_folder: folder of an authentic, undamaged release.
        payload, controller: those that all data were made with; None for those that the metadata of
            each recording name.
        joints: mapping of joint names, as in :class:`~pytest_twin.release.stamp.Stamp`.
        now: time of the stamp; the present time if None.

    Raises:
        ReleaseError: the release is not authentic, is damaged, states no digests, or lacks the
            payload or controller; a recording names another one; or a file names joints, none of
            which the release has.
        PathError: a file is a link.
        TwinError: a file that cannot contain a stamp, is damaged, or cannot be written.
    """
    now = now or datetime.now(UTC)
    # The release may have expired or have a successor: the data were recorded with it.
    released = read_authentic(release_folder, now)
    envelope = folders.read_envelope(release_folder)
    assert envelope is not None
    given = {"payload": payload, "controller": controller}
    found = []
    for carrier in carriers_in_child(dataset, writable=True):
        if carrier.path.is_symlink() and carrier.path.is_file():
            raise PathError(
                "is a link into a store, whose files must not change",
                path=carrier.path,
                value=carrier.path.resolve(),
                expected="a copy of the file, not a link (git annex unlock FILE, dvc unprotect "
                "FILE), which is then stamped",
            )
        compared = compare_joints(carrier.path, released, joints)
        if compared.are_foreign:
            raise ReleaseError(
                f"data of another robot: release {released.number} has none of its joints",
                path=carrier.path,
                value=list_names(compared.unknown),
                expected=f"{list_names(compared.released) or 'a release with joints'}; --joints "
                "RECORDED=RELEASED,... if the same joints have other names, --joints none if these "
                "names are no joints",
            )
        recorded = _recorded_variants(carrier, given)
        undeclared = {
            part: name
            for part, name in recorded.items()
            if given[part] is None and name not in stamp.variants_of(released, part)
        }
        used = {
            part: name or (None if part in undeclared else recorded.get(part))
            for part, name in given.items()
        }
        made = stamp.make(released, envelope, carrier.digest(), now, used, joints)
        path = carrier.path
        target = path.resolve() if path.is_symlink() else None
        found.append(
            StampedFile(carrier, made, undeclared=undeclared, joints=compared, target=target)
        )
    for one in found:
        assert one.stamp is not None
        one.carrier.write(one.stamp.to_text())
    accepted_releases.remember_twin(released.header.series, release_folder.absolute().parent.parent)
    return found


def _recorded_variants(carrier: Carrier, given: Mapping[str, str | None]) -> dict[str, str]:
    """Payload and controller that the metadata of one file name; they must be those given.

    Raises:
        ReleaseError: the metadata name another one.
    """
    if carrier.path.suffix.lower() != ".mcap":
        return {}
    recorded = McapStamp(carrier.path).trial()
    for part, name in given.items():
        if name is not None and recorded.get(part, name) != name:
            raise ReleaseError(
                f"its metadata name another {part}",
                path=carrier.path,
                where=part,
                value=recorded[part],
                expected=f"{name}, as --{part} says for all files",
            )
    return {part: recorded[part] for part in given if recorded.get(part)}


def read(dataset: Path) -> list[StampedFile]:
    """Read the stamps of a data set or policy, one for each file.

    Raises:
        TwinError: no file that can contain a stamp, or a damaged file.
        ReleaseError: no file is stamped.
    """
    found = [_read(carrier) for carrier in carriers_in_child(dataset, writable=False)]
    if not any(one.stamp or one.problem for one in found):
        raise ReleaseError(
            "is not stamped",
            path=dataset,
            expected="the stamp that pytest-twin stamp DATASET --release RELEASE writes",
        )
    return found


def _read(carrier: Carrier) -> StampedFile:
    text = carrier.read()
    if text is None:
        return StampedFile(carrier, None)
    try:
        return StampedFile(carrier, stamp.parse(text))
    except ReleaseError as error:
        return StampedFile(carrier, None, str(error))


def judge(
    found: list[StampedFile], keys: list[Key], *, now: datetime | None = None
) -> dict[Path, StampVerdict]:
    """Verify all stamps, and that they are of one release with joints of the data; file -> verdict.

    Raises:
        TwinError: a file cannot be read.
    """
    now = now or datetime.now(UTC)
    first = next((one.stamp for one in found if one.stamp is not None), None)
    verdicts: dict[Path, StampVerdict] = {}
    for one in found:
        path = one.carrier.path
        if one.stamp is None:
            verdicts[path] = StampVerdict(None, (one.problem or "is not stamped",))
            continue
        verdict = stamp.judge(one.stamp, keys, one.carrier.digest(), now)
        if first is not None and _without_variants(one.stamp) != _without_variants(first):
            other = f"stamped with {one.stamp.name}, and other files with {first.name}"
            verdict = replace(verdict, problems=(*verdict.problems, other))
        if verdict.release is not None:
            compared = compare_joints(path, verdict.release, one.stamp.joints)
            verdict = replace(verdict, note=compared.note)
            if compared.are_foreign:
                foreign = f"data of another robot: {compared.note}"
                verdict = replace(verdict, problems=(*verdict.problems, foreign), note="")
        verdicts[path] = verdict
    return verdicts


def _without_variants(given: Stamp) -> dict[str, object]:
    return {name: value for name, value in given.ids.items() if name not in stamp.VARIANTS}


def variants(found: Iterable[StampedFile]) -> dict[str, list[str]]:
    """Names in the stamps of a data set, by ``controller`` and ``payload``."""
    return {
        part: sorted({str(one.stamp.ids[part]["id"]) for one in found
                      if one.stamp is not None and one.stamp.ids[part]["id"] is not None})
        for part in stamp.VARIANTS
    }  # fmt: skip


def twins_near(dataset: Path, found: list[StampedFile]) -> Iterator[Path]:
    """Folders of twins that may have stamped a data set, the most probable first.

    These are the twin above the data set, the one above the working directory, and the recorded
    folder of the twin in the stamp.
    """
    given: dict[Path, None] = {}
    for start in (dataset.absolute(), Path.cwd()):
        file = find_twin(start)
        if file is not None:
            given[file.parent] = None
    for one in found:
        series = one.stamp.ids["series"] if one.stamp is not None else None
        if isinstance(series, str) and len(series) == 32 and set(series) <= _SERIES:
            root = accepted_releases.twin_of(series)
            if root is not None:
                given[root] = None
    yield from given


def keys_of(dataset: Path, found: list[StampedFile], folder: Path | None) -> list[Key]:
    """Trusted keys of a folder, or of the twin that stamped the data set.

    The result is empty if no stamp can be read.

    Raises:
        ReleaseError: no twin with keys was found.
    """
    if folder is not None:
        return trusted_keys.load_trusted(folder.resolve())
    if not any(one.stamp for one in found):
        return []
    root = twin_that_stamped(dataset, found)
    return trusted_keys.load_trusted(root / trusted_keys.FOLDER)


def twin_that_stamped(dataset: Path, found: list[StampedFile]) -> Path:
    """Folder of the twin whose keys verify a stamp, or of the most probable twin with keys.

    Raises:
        ReleaseError: no twin with keys was found.
    """
    nearest: Path | None = None
    now = datetime.now(UTC)
    for root in twins_near(dataset, found):
        try:
            keys = trusted_keys.load_trusted(root / trusted_keys.FOLDER)
        except TwinError:
            continue
        if not keys:
            continue
        nearest = nearest or root
        for one in found:
            if one.stamp is not None and stamp.judge(one.stamp, keys, "", now).release is not None:
                return root
    if nearest is None:
        raise ReleaseError(
            "no trusted keys for this stamp",
            path=dataset,
            expected="--keys DIR, or to be run in the folder of the twin that stamped it",
        )
    return nearest
