"""Today's stock: every part that goldens rest on, and every file behind them, before a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from pytest_twin.checks import check_of
from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.golden import Golden
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.twin import Twin


@dataclass(frozen=True, slots=True)
class Today:
    """What there is before a run.

    Attributes:
        parts: part id -> part.
        depends: ``golden@realization`` -> ids of all parts that its result rests on.
        files: file -> SHA-256.
        problems: what could not be found out, one line each.
    """

    parts: Mapping[str, Part]
    depends: Mapping[str, tuple[str, ...]]
    files: Mapping[Path, str]
    problems: tuple[str, ...] = ()


def take_stock(twin: Twin, goldens: Sequence[Golden]) -> Today:
    """Parts, dependencies and digests of a twin and its goldens, now."""
    parts: dict[str, Part] = {}
    depends: dict[str, tuple[str, ...]] = {}
    problems: list[str] = []
    files: dict[Path, None] = dict.fromkeys(twin.files)
    structures: dict[str, Structure] = {}
    with Sandbox(cwd=twin.root) as child:
        for name in dict.fromkeys(name for golden in goldens for name in golden.realizations):
            try:
                found = child.call(
                    "pytest_twin.gate.worker:features",
                    {"twin": str(twin.path), "realization": name},
                )
            except TwinError as error:
                problems.append(str(error))
                continue
            structures[name] = Structure.from_json(found["structure"])
            parts.update({i: Part(i, content) for i, content in found["parts"].items()})
            files.update(dict.fromkeys(map(Path, found["files"])))
    for golden in goldens:
        files[golden.path] = None
        if golden.trace is not None:
            files[golden.path.parent / golden.trace.file] = None
        for name in golden.realizations:
            own = list(_around(golden, twin, name))
            parts.update({part.id: part for part in own})
            ids = {part.id for part in own}
            if name in structures:
                ids |= set(check_of(golden.kind).depends(golden, structures[name]))
            depends[f"{golden.id}@{name}"] = tuple(sorted(ids))
    return Today(parts, depends, _digests(files), tuple(problems))


def _around(golden: Golden, twin: Twin, realization: str) -> Iterator[Part]:
    check = check_of(golden.kind)
    yield Part(f"check:{golden.kind}", {"version": check.version})
    simulator = twin.realizations[realization].simulator
    yield Part(f"simulator:{simulator}", {"version": metadata.version(simulator)})
    for library in check.libraries:
        yield Part(f"library:{library}", {"version": metadata.version(library)})
    yield Part(
        f"spec:{golden.id}",
        {
            "kind": golden.kind,
            "target": golden.target,
            "stimulus": golden.stimulus,
            "tolerance": {n: [q.value, q.unit] for n, q in golden.tolerance.items()},
            "expected": golden.expected,
        },
    )
    if golden.trace is not None:
        yield Part(f"trace:{golden.id}", {"sha256": golden.trace.sha256})


def _digests(files: Iterable[Path]) -> dict[Path, str]:
    return {path: file_sha256(path) for path in files}


def changed_files(files: Mapping[Path, str]) -> Iterator[str]:
    """Names of the files whose content is not what it was."""
    for path, before in files.items():
        try:
            now = file_sha256(path)
        except TwinError as error:
            yield str(error)
            continue
        if now != before:
            yield str(path)
