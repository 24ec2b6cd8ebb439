"""Write a patched realization: an MJCF, and a list of effects that MJCF cannot express.

The original model is never changed. Plain MuJoCo loads the MJCF; ``pytest-twin replay`` also
applies the listed effects.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.patched.model import MODEL_FILE, PatchedModel, effects_json
from pytest_twin.diagnosis.patched.native import NativeWriter
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.temperature import ColdFractions
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis
from pytest_twin.formats import atomic, yaml
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import CommandBetween
from pytest_twin.twin import EFFECTS_FILE, FILE_NAME, Twin, load_twin


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Simulation settings that follow from recordings.

    Attributes:
        cold_fractions: temperature -> cold fraction of the trials.
        substeps: substeps per step of the model, as in :class:`PatchedModel`.
        between: interpolation of commands between stamps if a recording does not state it; None if
            unknown.
    """

    cold_fractions: ColdFractions = field(default_factory=dict)
    substeps: int = 0
    between: CommandBetween | None = None


_DEFAULT_SETTINGS = RecordingSettings()


def write_realization(
    folder: Path,
    realization: Realization,
    problem: Problem,
    hypothesis: Hypothesis,
    inherited: PatchedModel | None = None,
    recorded: RecordingSettings = _DEFAULT_SETTINGS,
) -> PatchedModel:
    """Write ``model.xml``, ``effects.json`` and, if it is needed, ``twin.yaml``.

    Args:
        folder: new, empty folder.
        hypothesis: effects of the findings with their parameters.
        inherited: effects of the nominal model, if an earlier diagnosis wrote it.
        recorded: simulation settings that follow from the recordings.

    Raises:
        PathError: the folder cannot be written.
    """
    spec = realization.spec.copy()
    models = problem.simulator.models
    writer = NativeWriter(
        spec, problem.joints, problem.simulator.layout, lambda: models.contact, realization.twin
    )
    effects = list(inherited.effects) if inherited is not None else []
    for term in hypothesis.terms:
        theta = hypothesis.theta[hypothesis.slice_of(term)]
        values = {
            p.name: float(t * problem.scales.value(p, term.joint))
            for p, t in zip(term.parameters, theta, strict=True)
        }
        effects += writer.write(term, values)
    asked = any(catalogue()[e.effect].needs_temperature for e in effects)
    patched = PatchedModel(
        problem.joints,
        tuple(effects),
        recorded.cold_fractions if asked else {},
        problem.simulator.segments[0].has_friction_creep,
        recorded.substeps,
    )
    writer.write_friction_constraint(models.bounded_model(0))
    text = writer.text()
    if realization.source.kind == "mjcf":
        for name, path in realization.source.assets.items():
            if not name.endswith(".xml"):
                atomic.write_bytes(folder / name, path.read_bytes())
    atomic.write_text(folder / MODEL_FILE, text)
    atomic.write_json(folder / EFFECTS_FILE, effects_json(patched))
    between = recorded.between
    if realization.twin is not None:
        atomic.write_text(folder / FILE_NAME, twin_text(realization.twin, between))
    elif between is not None:
        data = {"name": "diagnosed", "model": MODEL_FILE, "command_between": between}
        atomic.write_text(folder / FILE_NAME, yaml.dump(data))
    return patched


def load_written(folder: Path) -> Realization:
    """Load the fitted model of a folder like other commands; it contains the nominal twin's fit.

    Raises:
        TwinError: the model cannot be loaded.
    """
    twin_file = folder / FILE_NAME
    return load(folder / MODEL_FILE, twin=load_twin(twin_file) if twin_file.is_file() else None)


def twin_text(twin: Twin, between: CommandBetween | None) -> str:
    """Return a ``twin.yaml`` for the patched model with the controllers and payloads of trials."""
    data: dict[str, Any] = {
        "name": f"{twin.name}-diagnosed",
        "model": MODEL_FILE,
        "topics": dict(twin.topics),
    }
    options = twin.recordings.to_json()
    if "command_between_default" in options:
        options["command_between"] = options.pop("command_between_default")
    elif between is not None:
        options["command_between"] = between
    data |= options
    if twin.controllers:
        data["controllers"] = {
            name: {actuator: dict(patch) for actuator, patch in actuators.items()}
            for name, actuators in twin.controllers.items()
        }
    if twin.payloads:
        data["payloads"] = {
            name: {body: asdict(payload) for body, payload in bodies.items()}
            for name, bodies in twin.payloads.items()
        }
    if twin.calibration is not None and twin.calibration.joints:
        data["calibration"] = {
            "id": twin.calibration.id,
            "joints": {joint: asdict(one) for joint, one in twin.calibration.joints.items()},
        }
    if twin.tcp is not None:
        data["tcp"] = twin.tcp
    return yaml.dump(data)
