"""Digests of the members of a twin: asset, calibration, fit, controller, payload, validation."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pytest_twin.dependency import canonical
from pytest_twin.golden import Golden
from pytest_twin.twin import Twin


def digests(twin: Twin, goldens: Iterable[Golden], files: Mapping[Path, str]) -> dict[str, str]:
    """SHA-256 of each member of a twin, hex.

    Asset and validation are digests of files. The others are digests of the values in
    ``twin.yaml`` and its files, so that a changed comment does not change them.

    Args:
        files: file -> SHA-256, for all files that the release depends on.
    """
    validation = {golden.path for golden in goldens}
    validation |= {g.path.parent / g.trace.file for g in goldens if g.trace is not None}
    stated = {twin.path, *(entry.record.path for entry in twin.calibrations)}
    stated |= {entry.record.path for entry in twin.fits}
    stated |= {part.path for part in (twin.calibration, twin.fit) if part is not None}
    stated |= {part.file for part in twin.parts.values() if part.file is not None}
    asset = files.keys() - validation - stated
    calibration, fit = twin.calibration, twin.fit
    return {
        "asset": _digest_of_files(twin, asset, files),
        "calibration": _digest(
            None
            if calibration is None
            else {
                "base": _dict_or_none(calibration.transform_world_to_base),
                "joints": {
                    name: _dict_or_none(joint) for name, joint in calibration.joints.items()
                },
                "records": sorted(files.get(e.record.path, "") for e in twin.calibrations),
            }
        ),
        "fit": _digest(None if fit is None else {"patches": fit.patches, "option": fit.option}),
        "controller": _digest(twin.controllers),
        "payload": _digest(
            {
                name: {body: _dict_or_none(added) for body, added in bodies.items()}
                for name, bodies in twin.payloads.items()
            }
        ),
        "validation": _digest_of_files(twin, validation, files),
    }


def _dict_or_none(item: Any) -> Any:
    return None if item is None else asdict(item)


def _digest(content: object) -> str:
    return hashlib.sha256(canonical(content)).hexdigest()


def _digest_of_files(twin: Twin, paths: Iterable[Path], files: Mapping[Path, str]) -> str:
    return _digest({os.path.relpath(p, twin.root): files[p] for p in paths if p in files})
