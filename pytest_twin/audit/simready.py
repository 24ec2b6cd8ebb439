"""Read what ``simready-validate --output FILE.json`` found in a stage, as evidence."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.errors import FormatError, SpecError
from pytest_twin.formats.paths import decode_text, read_bytes

SUFFIX = ".json"
_MAX_BYTES = 16 * 2**20
_PREFIXES = ("com.nvidia.simready.", "com.nvidia.")
_RUN = "simready-validate --profile Robot-Body STAGE --output FILE.json"


@dataclass(frozen=True, slots=True)
class SimReadyResult:
    """The result for one stage.

    Attributes:
        profile: name and version of the profile.
        failed: failed requirement -> what the validator says, empty where it says nothing.
        optional: failed requirements of optional features only.
    """

    profile: str
    failed: Mapping[str, tuple[str, ...]]
    optional: frozenset[str]


@dataclass(frozen=True, slots=True)
class SimReadyResults:
    """The results in one file: path of a stage, as the validator was given it -> result."""

    path: Path
    by_stage: Mapping[str, SimReadyResult]


def load(path: Path) -> SimReadyResults:
    """Read the validator's JSON.

    Raises:
        FormatError: not JSON, or not the validator's.
    """
    text = decode_text(read_bytes(path, _MAX_BYTES), path)
    try:
        data = json.loads(text)
        results = {str(stage): _result(entry) for stage, entry in data.items()}
    except (ValueError, SyntaxError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise FormatError(
            f"not a result of simready-validate: {type(error).__name__}: {error}",
            path=path,
            expected=f"what this writes: {_RUN}",
        ) from None
    return SimReadyResults(path, results)


def _result(entry: Mapping[str, Any]) -> SimReadyResult:
    failed: dict[str, tuple[str, ...]] = {}
    optional: set[str] = set()
    features = entry["features_summary"]
    if not features:
        raise ValueError("no feature was validated")
    for feature in features.values():
        messages = json.loads(feature.get("requirement_messages", "{}"))
        if feature["blocking_failure"]:
            for name in _names(feature["failing requirements"]):
                failed[name] = tuple(str(message) for message in messages.get(name, ()))
        elif not feature["passed"]:
            optional |= set(_names(feature.get("optional requirements", "[]")))
    profile = f"{entry['profile_id']} {entry['profile_version']}"
    return SimReadyResult(profile, failed, frozenset(optional) - failed.keys())


def _names(text: str) -> list[str]:
    """Read the validator's text of a Python list of names."""
    return [str(name) for name in ast.literal_eval(text)]


def check(asset: Asset, results: SimReadyResults) -> Iterator[Finding]:
    """Yield what the validator found in the audited stage.

    Raises:
        SpecError: the file has no result for this stage, or several.
    """
    stages = [name for name in results.by_stage if Path(name).name == asset.path.name]
    if len(stages) != 1:
        raise SpecError(
            f"{len(stages)} results for a stage of this name",
            path=results.path,
            value=asset.path.name,
            expected=f"one result of: {_RUN}",
        )
    result = results.by_stage[stages[0]]
    element = f"profile '{result.profile}'"
    if results.path.stat().st_mtime < asset.path.stat().st_mtime:
        yield finding_of("simready.older", asset.place, element)
    for name, messages in sorted(result.failed.items()):
        yield finding_of(
            "simready.required",
            asset.place,
            f"requirement '{_short(name)}'",
            title=f"{element} requires it, and it fails" + _of(messages),
        )
    if not result.failed:
        yield finding_of("simready.passed", asset.place, element)
    if result.optional:
        names = ", ".join(sorted(_short(name) for name in result.optional))
        yield finding_of("simready.optional", asset.place, element, names)


def _of(messages: Iterable[str]) -> str:
    texts = [" ".join(message.split()) for message in messages]
    if not texts:
        return ""
    return f": {texts[0][:200]}" + (f" (and {len(texts) - 1} more)" if texts[1:] else "")


def _short(name: str) -> str:
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    return name
