"""Write the folder of an identification: the fitted model, which every command can load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.patched.model import (
    MODEL_FILE,
    AppliedEffect,
    PatchedModel,
    effects_json,
    read_patched_model,
)
from pytest_twin.diagnosis.patched.write import load_written, twin_text
from pytest_twin.effects import catalogue
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic, yaml
from pytest_twin.formats.identification_record import EncoderChange
from pytest_twin.identification.known_effects import kept_effects
from pytest_twin.realization import Realization, mjcf, mjcf_file, patch
from pytest_twin.twin import EFFECTS_FILE, FILE_NAME, Calibration, JointCalibration

Patches = dict[str, dict[str, dict[str, Any]]]
"""Family -> element -> attribute -> value, as the table ``fit:`` of a twin."""


@dataclass(frozen=True)
class ModelChanges:
    """Changes of a model by an identification.

    Attributes:
        patches: family -> element -> attribute -> value.
        encoders: joint -> its calibration before and after.
        laws: effects that no MJCF contains.
    """

    patches: Patches = field(default_factory=dict)
    encoders: Mapping[str, EncoderChange] = field(default_factory=dict)
    laws: Sequence[AppliedEffect] = ()


def write_fitted(
    folder: Path, realization: Realization, changes: ModelChanges = ModelChanges()
) -> None:
    """Write ``model.xml`` with the fit, and ``twin.yaml`` with the fields that no MJCF has.

    These are the controllers and payloads of the nominal twin, and the encoders. ``effects.json``
    has the effects of the nominal model that its MJCF does not contain.

    Args:
        folder: a new, empty folder.

    Raises:
        SpecError: the fit names an element that the model does not have.
        ModelError: MuJoCo refuses the fitted model.
    """
    spec = realization.spec.copy()

    def refuse(where: str, problem: str, **details: Any) -> SpecError:
        return SpecError(problem, path=realization.path, where=where, **details)

    patch.apply_fit(spec, changes.patches, {}, refuse=refuse)
    model, _ = mjcf.compile_spec(spec)
    if realization.source.kind == "mjcf":
        for name, path in realization.source.assets.items():
            if not name.endswith(".xml"):
                atomic.write_bytes(folder / name, path.read_bytes())
    atomic.write_text(folder / MODEL_FILE, mjcf_file.with_exact_inertia(spec, model))
    effects = kept_effects(realization)
    if effects is not None:
        text = atomic.json_text(effects_json(effects))
        atomic.write_text(folder / EFFECTS_FILE, text)
    twin = realization.twin
    after = {joint: JointCalibration(**one.after) for joint, one in changes.encoders.items()}
    if twin is not None:
        stated = twin.calibration or Calibration("identified", None, {}, twin.path)
        own = replace(stated, joints={**stated.joints, **after})
        atomic.write_text(folder / FILE_NAME, twin_text(replace(twin, calibration=own), None))
    elif changes.encoders:
        joints = {joint: dict(one.after) for joint, one in changes.encoders.items()}
        data = {
            "name": "identified",
            "model": MODEL_FILE,
            "calibration": {"id": "identified", "joints": joints},
        }
        atomic.write_text(folder / FILE_NAME, yaml.dump(data))
    add_effects(folder, tuple(realization.joints), changes.laws)


def add_effects(folder: Path, joints: tuple[str, ...], new: Sequence[AppliedEffect]) -> None:
    """Add effects that no MJCF contains to ``effects.json`` of a fitted model.

    Args:
        folder: folder of the fitted model.
        new: effects. One of a reading that the model already has is applied after it.
    """
    if not new:
        return
    patched = read_patched_model(load_written(folder)) or PatchedModel(joints)
    effects = list(patched.effects)
    for one in new:
        same = [e for e in effects if (e.effect, e.joint) == (one.effect, one.joint)]
        effects = [e for e in effects if e not in same]
        effects.append(_after(same[0], one, patched) if same else one)
    every = (*patched.joints, *(joint for joint in joints if joint not in patched.joints))
    written = effects_json(replace(patched, joints=every, effects=tuple(effects)))
    atomic.write_json(folder / EFFECTS_FILE, written)


def _after(before: AppliedEffect, new: AppliedEffect, patched: PatchedModel) -> AppliedEffect:
    """Return one effect for readings that the given model already corrects.

    reading = (1 + e) effort + b. The new effect holds for the corrected effort.
    """
    if new.effect == EffortScale.id:
        scale = (1.0 + before.values["scale_error"]) * (1.0 + new.values["scale_error"])
        return replace(new, values={"scale_error": scale - 1.0})
    if catalogue()[new.effect].regressor_symbol and new.effect != EffortBias.id:
        # The fit took the earlier effect as given.
        return replace(new, values={n: before.values[n] + v for n, v in new.values.items()})
    if new.effect != EffortBias.id:
        return new
    scale = 1.0 + sum(
        e.values["scale_error"]
        for e in patched.effects
        if (e.effect, e.joint) == (EffortScale.id, new.joint)
    )
    return replace(new, values={"bias": before.values["bias"] + scale * new.values["bias"]})
