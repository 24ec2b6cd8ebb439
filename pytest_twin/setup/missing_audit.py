"""Add the golden that audits the model to a twin that has none."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.checks.asset import AssetAudit, audit_spec
from pytest_twin.errors import TwinError
from pytest_twin.gate.specs import golden_id, load_golden, spec_paths
from pytest_twin.setup.writing import spec_places, write_spec
from pytest_twin.twin import Twin


def add_audit(twin: Twin) -> Path | None:
    """Write the first golden of kind ``asset``; None if one exists or no file can be audited.

    A twin that has it under ``retired:`` gets none.

    Raises:
        PathError: the folder cannot be written.
    """
    spec = audit_spec(twin)
    if spec is None or any(_is_audit(path, twin) for path in spec_paths(twin)):
        return None
    kind = AssetAudit.kind
    (path,) = spec_places(twin.root, [{"kind": kind, **spec}])
    if path.exists() or golden_id(path, twin) in twin.retired:
        return None
    write_spec(twin.root, path, {"kind": kind, **spec})
    return path


def _is_audit(path: Path, twin: Twin) -> bool:
    try:
        return load_golden(path, twin).kind == AssetAudit.kind
    except TwinError:
        return False
