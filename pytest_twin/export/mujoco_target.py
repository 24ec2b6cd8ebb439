"""Plain MJCF that MuJoCo loads and steps without this package."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.asset.loss.matrix import Row, Verdict
from pytest_twin.diagnosis.patched.model import MODEL_FILE
from pytest_twin.effects import catalogue
from pytest_twin.effects.contact_geoms import ContactGeoms, find_contact_geoms
from pytest_twin.effects.layout import Layout
from pytest_twin.errors import ModelError, SpecError, TwinError
from pytest_twin.export import measure
from pytest_twin.export.expression import Expression
from pytest_twin.export.integration import Integration, integrations
from pytest_twin.export.mjcf_forms import ExportedMjcf, MjcfExporter
from pytest_twin.export.mujoco_replay import replay_exported
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported
from pytest_twin.formats import atomic
from pytest_twin.open_loop import row_of
from pytest_twin.realization import Realization, mjcf_file
from pytest_twin.trial import Trial

_NOT_MEASURED = "not measured: no held-out recording"
_UNIT = "of the diagnosed model's error"
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``model.xml``, one model for each controller, and meshes into an empty folder.

    Raises:
        TwinError: the model has files that cannot be written, or does not load.
    """
    return MujocoExport(source).write(folder)


class MujocoExport:
    """The MJCF of a source, in variants for each controller and payload.

    Args:
        source: the model with its effects.
        for_mjx: whether the files are for MJX.
    """

    def __init__(self, source: ExportSource, *, for_mjx: bool = False) -> None:
        self.source, self.for_mjx = source, for_mjx
        self.realization = source.loaded.realization
        self.trials = measure.chosen_trials(source.held_out)
        self._variants: dict[tuple[str | None, str | None], ExportedMjcf] = {}

    def variant(self, realization: Realization) -> ExportedMjcf:
        """The effects written into one variant of the realization."""
        key = realization.controller, realization.payload
        if key not in self._variants:
            patched = self.source.patched
            exporter = MjcfExporter(
                realization.spec.copy(), patched.joints, lambda: self._contact(realization),
                for_mjx=self.for_mjx,
            )  # fmt: skip
            for effect in patched.effects:
                exporter.add(effect)
            self._variants[key] = exporter.finish()
        return self._variants[key]

    def _contact(self, realization: Realization) -> ContactGeoms:
        joints = np.array([realization.joint_index(j) for j in self.source.patched.joints])
        poses = [
            trial.position[:, [trial.joints.index(j) for j in self.source.patched.joints]]
            for trial in self.trials
        ]
        if not poses:
            raise SpecError(
                "a contact effect needs recordings", where="--held-out",
                expected="recordings that show which surfaces the robot touches",
            )  # fmt: skip
        return find_contact_geoms(realization.model, joints, poses)

    def write(self, folder: Path) -> Exported:
        """Write all files; see :func:`export`."""
        nominal = self.variant(self.realization)
        reference = self._reference()
        candidates = integrations(nominal.spec.compile())
        if reference:
            chosen, errors, errors_as_is = measure.first_within(candidates, self._errors, reference)
        else:
            chosen, errors, errors_as_is = candidates[0], {}, {}
        files = [self._write_model(folder, MODEL_FILE, nominal, chosen)]
        twin = self.realization.twin
        for controller in () if twin is None else twin.controllers:
            if not _PLAIN_NAME.fullmatch(controller):
                raise SpecError(
                    "no file can have the name of this controller", path=self.source.path,
                    where="controllers", value=controller, expected="letters, digits, - and _",
                )  # fmt: skip
            variant = self.variant(self.realization.variant(controller))
            files.append(self._write_model(folder, f"model_{controller}.xml", variant, chosen))
        copy_assets(self.realization, folder)
        for name in files:
            self._load(folder / name)
        joint_increase = measure.increase(errors, reference)
        rows = [
            measured_row(e, self.source, self.trials, reference, joint_increase)
            for e in nominal.expressions
        ]
        rows.append(integration_row(candidates[0], chosen, reference, errors, errors_as_is))
        return Exported(
            tuple(files),
            f"mujoco {mujoco.__version__}",
            "stepped" if reference else "loaded",
            tuple(rows),
            joint_errors(self.realization, reference, errors),
            () if reference else (f"the loss is {_NOT_MEASURED}",),
        )

    def _reference(self) -> measure.Errors:
        if not self.trials:
            return {}
        return measure.patched_errors(self.realization, self.source.loaded.patched, self.trials)

    def _errors(self, integration: Integration) -> measure.Errors:
        predicted = [
            dict(zip(trial.joints, self._replay(trial, integration).T, strict=True))
            for trial in self.trials
        ]
        return measure.errors_of(self.trials, predicted)

    def _replay(self, trial: Trial, integration: Integration) -> FloatArray:
        row = row_of(self.realization, trial)
        controller, payload = (
            trial.metadata.get(key) if self._declares(f"{key}s") else None
            for key in ("controller", "payload")
        )
        exported = self.variant(self.realization.variant(controller or None, payload or None))
        spec = exported.spec.copy()
        integration.apply(spec, exported.bristles)
        return replay_exported(exported, spec.compile(), row)

    def _declares(self, table: str) -> bool:
        twin = self.realization.twin
        return twin is not None and bool(getattr(twin, table))

    def _write_model(
        self, folder: Path, name: str, exported: ExportedMjcf, integration: Integration
    ) -> str:
        spec = exported.spec.copy()
        integration.apply(spec, exported.bristles)
        model = spec.compile()
        atomic.write_text(folder / name, mjcf_file.with_exact_inertia(spec, model))
        return name

    @staticmethod
    def _load(path: Path) -> None:
        try:
            mujoco.MjModel.from_xml_path(str(path))
        except (ValueError, mujoco.FatalError) as error:
            raise ModelError(
                f"MuJoCo does not load the written file: {' '.join(str(error).split())}",
                path=path,
            ) from None


def joint_errors(
    realization: Realization, reference: measure.Errors, errors: measure.Errors
) -> dict[str, dict[str, object]]:
    """Joint -> errors of the diagnosed and of the exported model, with their unit."""
    return {
        joint: {
            "rms_diagnosed": reference[joint],
            "rms_exported": errors[joint] if math.isfinite(errors[joint]) else None,
            "unit": "m" if realization.structure.joint_type[joint] == "slide" else "rad",
        }
        for joint in reference
        if joint in errors
    }


def measured_row(
    expression: Expression,
    source: ExportSource,
    trials: Sequence[Trial],
    reference: measure.Errors,
    increase: Mapping[str, float],
    incomplete: Collection[str | None] = (),
) -> Row:
    """The row of an effect with its measured cost.

    Args:
        expression: how it was written.
        source: the model with its effects.
        trials: the recordings that measure.
        reference: errors of the diagnosed model; empty without recordings.
        increase: joint -> relative increase of its error in the export.
        incomplete: joints with a lost effect, None for one of the whole robot. There the cost of
            what is kept is not known.
    """
    difference, comparison = None, _NOT_MEASURED
    if reference and expression.verdict != "lost":
        joint = expression.joint
        if joint in incomplete or None in incomplete:
            return effect_row(expression, source, "not measured beside a lost effect", None)
        joints = [joint] if joint is not None and joint in increase else list(increase)
        difference = max((increase[name] for name in joints), default=None)
        comparison = "held-out error of the exported model"
    elif reference:
        difference = _cost(expression, source, trials, reference)
        comparison = "held-out error of the diagnosed model without this effect"
        if difference is None and expression.joint in incomplete and expression.joint is not None:
            difference = increase.get(expression.joint)
            comparison = "held-out error of the exported model, without all lost effects"
    return effect_row(expression, source, comparison, difference)


def _cost(
    expression: Expression,
    source: ExportSource,
    trials: Sequence[Trial],
    reference: measure.Errors,
) -> float | None:
    patched = source.loaded.patched
    if patched is None:
        return None
    reduced = measure.without(patched, *expression.place)
    if reduced == patched:
        return None
    try:
        errors = measure.patched_errors(source.loaded.realization, reduced, trials)
    except TwinError:
        return None
    return max(measure.increase(errors, reference).values(), default=None)


def copy_assets(realization: Realization, folder: Path) -> None:
    """Copy meshes and textures of a model into a folder.

    Raises:
        ModelError: one of them would lie outside the folder.
    """
    root = folder.resolve()
    for name, path in realization.source.assets.items():
        target = (folder / name).resolve()
        if not target.is_relative_to(root):
            raise ModelError(
                "a file of the model lies outside its folder", path=path, value=name,
                expected="meshes and textures in the model's folder or below it",
            )  # fmt: skip
        if not name.endswith(".xml"):
            atomic.write_bytes(target, path.read_bytes())


def effect_row(
    expression: Expression, source: ExportSource, comparison: str, difference: float | None
) -> Row:
    """The row of an effect: its parameters, how it was written, and what it costs."""
    patched, law = source.patched, catalogue()[expression.effect]
    layout = Layout.of_model(source.loaded.realization.model, patched.joints)
    column = 0 if expression.joint is None else patched.joints.index(expression.joint)
    kind, servo = "slide" if layout.slides[column] else "hinge", str(layout.servo[column])
    values = ", ".join(
        f"{p.reported_name} {p.reported(expression.values[p.name]):.6g} {p.unit(kind, servo)}"
        for p in law.parameters
        if p.name in expression.values
    )
    if difference is not None and not math.isfinite(difference):
        comparison, difference = f"{comparison}: the simulation diverges", None
    after = "; ".join(part for part in (expression.written, expression.why) if part)
    verdict: Verdict = expression.verdict
    if verdict == "kept" and difference is not None and difference > measure.TOLERANCE:
        verdict = "changed"
    return Row(
        expression.words, verdict, values, after, comparison, difference,
        None if difference is None else measure.TOLERANCE, "" if difference is None else _UNIT,
    )  # fmt: skip


def integration_row(
    before: Integration,
    after: Integration,
    reference: measure.Errors,
    errors: measure.Errors,
    errors_as_is: measure.Errors,
) -> Row:
    """The row of the integration, whose error pytest-twin removes and a plain simulation has."""
    if not reference:
        return Row("integration", "kept", before.words, after.words, _NOT_MEASURED)
    as_is = max(measure.increase(errors_as_is, reference).values(), default=0.0)
    difference = max(measure.increase(errors, reference).values(), default=0.0)
    verdict: Verdict = "kept" if after == before else "changed"
    return Row(
        "integration", verdict, before.words,
        after.words if after == before else f"{after.words}; as before: {as_is:+.1%} error",
        "held-out error of the exported model", difference, measure.TOLERANCE, _UNIT,
    )  # fmt: skip
