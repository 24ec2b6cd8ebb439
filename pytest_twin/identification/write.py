"""The folder of an identification: the fitted model, which every command takes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.patched.model import MODEL_FILE
from pytest_twin.diagnosis.patched.write import twin_text
from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic
from pytest_twin.realization import Realization, mjcf, patch
from pytest_twin.twin import FILE_NAME


def write_fitted(
    folder: Path, realization: Realization, patches: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write ``model.xml`` with the fit in it and, of a twin, ``twin.yaml`` with its controllers.

    Args:
        folder: new, empty.
        realization: the nominal model.
        patches: family -> element -> attribute -> value.

    Raises:
        SpecError: the fit names what the model lacks.
        ModelError: MuJoCo refuses the fitted model.
    """
    spec = realization.spec.copy()

    def refuse(where: str, problem: str, **details: Any) -> SpecError:
        return SpecError(problem, path=realization.path, where=where, **details)

    patch.apply_fit(spec, patches, {}, refuse=refuse)
    mjcf.compiled(spec)
    if realization.source.kind == "mjcf":
        for name, path in realization.source.assets.items():
            if not name.endswith(".xml"):
                atomic.write_bytes(folder / name, path.read_bytes())
    atomic.write_text(folder / MODEL_FILE, str(spec.to_xml()))
    if realization.twin is not None:
        atomic.write_text(folder / FILE_NAME, twin_text(realization.twin, None))
