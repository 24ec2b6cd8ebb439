"""The patched realization: plain MJCF where MuJoCo has the physics, ``effects.json`` for the rest.

The asset is never touched: what is written is a model of its own, that plain MuJoCo loads, and a
list of effects that ``pytest-twin replay`` steps beside it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.prepare import _segments
from pytest_twin.diagnosis.problem import REFINE, Problem, corrected, step_error
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.rows import EffectValues, Predicted, RowSimulator, Segment
from pytest_twin.errors import RecordingError, SimulationError, SpecError
from pytest_twin.formats import atomic
from pytest_twin.realization import Realization, patch
from pytest_twin.realization.mjcf import compiled
from pytest_twin.replay import calibration_of
from pytest_twin.trial import Trial
from pytest_twin.twin import FILE_NAME, Payload, Twin

EFFECTS_FILE = "effects.json"
MODEL_FILE = "model.xml"
_MAX_EFFECTS = 256
_MAX_BYTES = 1 << 20
# A delay line holds this many steps beyond the delay itself.
_SPARE_SAMPLES = 3


@dataclass(frozen=True, slots=True)
class AppliedEffect:
    """One effect of a patched realization.

    Attributes:
        effect, joint: what and where; joint None for the whole robot's.
        values: parameter -> SI value, as the law takes it.
        in_model: whether the MJCF holds it.
        written: what of the MJCF says it; empty where nothing does.
    """

    effect: str
    joint: str | None
    values: Mapping[str, float]
    in_model: bool
    written: str = ""


@dataclass(frozen=True, slots=True)
class Patched:
    """What stands in ``effects.json``.

    Attributes:
        joints: columns that laws act on, in order.
        effects: all, those in the model too.
    """

    joints: tuple[str, ...]
    effects: tuple[AppliedEffect, ...] = field(default=())

    @property
    def beside(self) -> tuple[AppliedEffect, ...]:
        """Those that are stepped beside the model."""
        return tuple(e for e in self.effects if not e.in_model)


# -- writing


def write_realization(
    folder: Path,
    realization: Realization,
    problem: Problem,
    hypothesis: Hypothesis,
    inherited: Patched | None = None,
) -> Patched:
    """Write ``model.xml``, ``effects.json`` and, with controllers or payloads, ``twin.yaml``.

    Args:
        folder: new, empty.
        realization: the model as it came.
        problem: that was explained.
        hypothesis: its findings.
        inherited: effects of the realization that was diagnosed, where it was a patched one.

    Raises:
        PathError: the folder cannot be written.
    """
    spec = realization.spec.copy()
    writer = _NativeWriter(spec, realization, problem)
    effects = list(inherited.effects) if inherited is not None else []
    for term in hypothesis.terms:
        theta = hypothesis.theta[hypothesis.slice_of(term)]
        values = {
            p.name: float(t * problem.scales.value(p, term.joint))
            for p, t in zip(term.parameters, theta, strict=True)
        }
        effects += writer.take(term, values)
    patched = Patched(problem.joints, tuple(effects))
    writer.settle()
    text = writer.text()
    if realization.source.kind == "mjcf":
        for name, path in realization.source.assets.items():
            if not name.endswith(".xml"):
                atomic.write_bytes(folder / name, path.read_bytes())
    atomic.write_text(folder / MODEL_FILE, text)
    atomic.write_text(folder / EFFECTS_FILE, json.dumps(effects_json(patched), indent=2) + "\n")
    if realization.twin is not None:
        atomic.write_text(folder / FILE_NAME, _twin_text(realization.twin))
    return patched


def effects_json(patched: Patched) -> dict[str, Any]:
    """As the file has it."""
    laws = catalogue()
    return {
        "schema": 1,
        "joints": list(patched.joints),
        "effects": [
            {
                "effect": e.effect,
                "joint": e.joint,
                "values": dict(e.values),
                "in_model": e.in_model,
                **({"written": e.written} if e.written else {}),
                "law": laws[e.effect].law,
            }
            for e in patched.effects
        ],
    }


def _twin_text(twin: Twin) -> str:
    """A ``twin.yaml`` for the patched model: what trials' metadata selects stays selectable."""
    data: dict[str, Any] = {
        "name": f"{twin.name}-diagnosed",
        "model": MODEL_FILE,
        "topics": dict(twin.topics),
    }
    if twin.controllers:
        data["controllers"] = {
            name: {a: {k: _plain(v) for k, v in p.items()} for a, p in actuators.items()}
            for name, actuators in twin.controllers.items()
        }
    if twin.payloads:
        data["payloads"] = {
            name: {
                body: {"mass": p.mass, "com": list(p.com), "inertia": list(p.inertia)}
                for body, p in bodies.items()
            }
            for name, bodies in twin.payloads.items()
        }
    if twin.calibration is not None and twin.calibration.joints:
        data["calibration"] = {
            "id": twin.calibration.id,
            "joints": {
                j: {"offset": c.offset, "sign": c.sign} for j, c in twin.calibration.joints.items()
            },
        }
    if twin.tcp is not None:
        data["tcp"] = twin.tcp
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _plain(value: float | tuple[float, ...]) -> float | list[float]:
    return list(value) if isinstance(value, tuple) else value


class _NativeWriter:
    """Writes effects into a spec, one after another, where MuJoCo has their law."""

    def __init__(self, spec: mujoco.MjSpec, realization: Realization, problem: Problem) -> None:
        self.spec, self.problem = spec, problem
        self.simulator = problem.simulator
        twin = realization.twin
        # Controllers and payloads overwrite gains and add masses when a trial asks for them: what
        # is in proportion to those has to come after.
        self.fixed_gains = twin is None or not twin.controllers
        self.fixed_masses = twin is None or not twin.payloads
        self.model = compiled(spec)[0]

    def take(self, term: Term, values: Mapping[str, float]) -> list[AppliedEffect]:
        """Write the effect into the model as far as it goes; what is left stays beside it."""
        joint = None if term.joint < 0 else self.problem.joints[term.joint]
        beside = AppliedEffect(term.effect, joint, dict(values), in_model=False)
        write = _NATIVE.get(term.effect)
        if write is None:
            return [beside]
        before = self.spec.copy()
        try:
            written = write(self, term.joint, dict(values))
            if written is None:
                self.spec = before
                return [beside]
            text, rest = written
            self.model = compiled(self.spec)[0]
        except (ValueError, RuntimeError, mujoco.FatalError):
            # A value that MJCF does not take, such as a damping below zero, is stepped beside it.
            self.spec = before
            self.model = compiled(self.spec)[0]
            return [beside]
        inside = {k: v for k, v in values.items() if k not in rest}
        out = [AppliedEffect(term.effect, joint, inside, in_model=True, written=text)]
        if rest:
            neutral = {p.name: p.neutral or 0.0 for p in term.parameters}
            out.append(AppliedEffect(term.effect, joint, {**neutral, **rest}, in_model=False))
        return out

    def settle(self) -> None:
        """State the solver settings under which the findings hold."""
        timestep = float(self.model.opt.timestep)
        by_name = {j.name: j for j in self.spec.joints}
        for name in self.problem.joints:
            # As the row simulator has them: MuJoCo's default lets dry friction creep under load.
            joint = by_name[name]
            joint.solref_friction[:] = (2.0 * timestep, 1.0)
            joint.solimp_friction[:3] = (0.999, 0.9999, 0.001)
        self.model = compiled(self.spec)[0]

    def text(self) -> str:
        """The MJCF."""
        return str(self.spec.to_xml())

    # -- helpers of the laws below

    def refuse(self, where: str, problem: str, **details: Any) -> SpecError:
        return SpecError(problem, where=where, **details)

    def fit(self, family: str, name: str, values: Mapping[str, Any]) -> None:
        patch.apply_fit(self.spec, {family: {name: values}}, {}, refuse=self.refuse)

    def joint_index(self, joint: int) -> tuple[str, int, int]:
        """Name, joint id and dof of a column."""
        return (
            self.problem.joints[joint],
            int(self.simulator.joint_ids[joint]),
            int(self.simulator.dof_index[joint]),
        )

    def actuator_name(self, joint: int) -> str | None:
        """Of the drive of a column, or None without one that has a name."""
        at = int(self.simulator.actuator[joint])
        if at < 0:
            return None
        return mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, at) or None

    def body_name(self, joint: int) -> str:
        at = int(self.simulator.body_index[joint])
        return str(mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_BODY, at))


Written = tuple[str, dict[str, float]] | None
"""What of the MJCF says it, and the parameters that are left over."""


def _viscous(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    total = float(w.model.dof_damping[dof]) + values["coefficient"]
    if total < 0.0:
        return None
    _add_damping(w, name, 0, values["coefficient"])
    return f"joint '{name}' damping", {}


def _add_damping(w: _NativeWriter, name: str, order: int, value: float) -> None:
    joint = next(j for j in w.spec.joints if j.name == name)
    poly = np.array(joint.damping, dtype=float)
    poly[order] += value
    joint.damping = poly


def _drag(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    if values["coefficient"] + float(w.model.dof_dampingpoly[dof, 0]) < 0.0:
        return None
    _add_damping(w, name, 1, values["coefficient"])
    return f"joint '{name}' damping, second coefficient", {}


def _dry(w: _NativeWriter, joint: int, level: float) -> str:
    name, _, dof = w.joint_index(joint)
    total = max(float(w.model.dof_frictionloss[dof]) + level, 0.0)
    w.fit("joint", name, {"frictionloss": total})
    return f"joint '{name}' frictionloss"


def _coulomb(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    return _dry(w, joint, values["coulomb"]), {}


def _asymmetric(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    return _dry(w, joint, values["coulomb"]), {"offset": values["offset"]}


def _armature(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    total = float(w.model.dof_armature[dof]) + values["inertia"]
    if total < 0.0:
        return None
    w.fit("joint", name, {"armature": total})
    return f"joint '{name}' armature", {}


def _spring(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, index, _ = w.joint_index(joint)
    address = int(w.simulator.qpos_index[joint])
    total = float(w.model.jnt_stiffness[index]) + values["stiffness"]
    if total <= 0.0:
        return None
    rest = float(w.model.qpos_spring[address]) + values["preload"] / total
    w.fit("joint", name, {"stiffness": total, "springref": rest})
    return f"joint '{name}' stiffness and springref", {}


def _gains(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains:
        return None
    at = int(w.simulator.actuator[joint])
    stiffness, damping = 1.0 + values["stiffness_error"], 1.0 + values["damping_error"]
    gain, bias = w.model.actuator_gainprm[at].copy(), w.model.actuator_biasprm[at].copy()
    gain[0] *= damping if w.simulator.servo[joint] == "velocity" else stiffness
    bias[1] *= stiffness
    bias[2] *= damping
    w.fit("actuator", name, {"gainprm": gain.tolist(), "biasprm": bias.tolist()})
    return f"actuator '{name}' gains", {}


def _torque_constant(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains:
        return None
    at, factor = int(w.simulator.actuator[joint]), 1.0 + values["relative_error"]
    if factor <= 0.0:
        return None
    changed: dict[str, Any] = {
        "gainprm": (w.model.actuator_gainprm[at] * factor).tolist(),
        "biasprm": (w.model.actuator_biasprm[at] * factor).tolist(),
    }
    if w.model.actuator_forcelimited[at]:
        changed["forcerange"] = (w.model.actuator_forcerange[at] * factor).tolist()
    w.fit("actuator", name, changed)
    return f"actuator '{name}' gains and forcerange", {}


def _saturation(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains or values["inverse_limit"] <= 0.0:
        return None
    at = int(w.simulator.actuator[joint])
    limit = 1.0 / values["inverse_limit"] / abs(float(w.simulator.gear[joint]))
    ends = np.array([-limit, limit])
    if w.model.actuator_forcelimited[at]:
        ends = np.clip(w.model.actuator_forcerange[at], -limit, limit)
    if ends[0] >= ends[1]:
        return None
    w.fit("actuator", name, {"forcerange": ends.tolist()})
    return f"actuator '{name}' forcerange", {}


def _delay(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None:
        return None
    actuator = next(a for a in w.spec.actuators if a.name == name)
    total = float(actuator.delay) + values["delay"]
    actuator.delay = total
    actuator.nsample = math.ceil(total / float(w.model.opt.timestep)) + _SPARE_SAMPLES
    actuator.interp = 1
    return f"actuator '{name}' delay", {}


def _inertial(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    if not w.fixed_masses:
        return None
    body, factor = w.body_name(joint), 1.0 + values["relative_error"]
    mass, tensor = _compiled_inertia(w.model, int(w.simulator.body_index[joint]))
    w.fit("body", body, {"mass": mass * factor, "inertia": _six(tensor * factor)})
    return f"body '{body}' mass and inertia", {}


def _payload(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    del joint
    last = len(w.problem.joints) - 1
    body = w.body_name(last)
    model, at = w.model, int(w.simulator.joint_ids[last])
    center = model.jnt_pos[at] + values["distance"] * w.simulator.directions[last]
    index = int(w.simulator.body_index[last])
    if not w.fixed_masses or float(model.body_mass[index]) + values["mass"] <= 1e-6:
        return None
    x, y, z = (float(c) for c in center)
    payload = Payload(values["mass"], (x, y, z))
    patch.apply_payload(w.spec, {body: payload}, where="payload", refuse=w.refuse)
    return f"body '{body}' mass, centre and inertia", {}


def _tilt(w: _NativeWriter, joint: int, values: dict[str, float]) -> Written:
    del joint
    from pytest_twin.effects.base import ModelFields

    one = np.zeros((1, 1))
    fields = ModelFields(one, one, one, one, one, np.array([w.model.opt.gravity]), one, one, one)
    catalogue()["base_tilt"].fields(fields, {k: np.full((1, 1), v) for k, v in values.items()})
    w.spec.option.gravity = fields.gravity[0]
    return "option gravity", {}


def _compiled_inertia(model: mujoco.MjModel, body: int) -> tuple[float, FloatArray]:
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[body])
    rotation = flat.reshape(3, 3)
    return float(model.body_mass[body]), rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def _six(tensor: FloatArray) -> list[float]:
    return [float(tensor[i, k]) for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


_NATIVE: Mapping[str, Callable[[_NativeWriter, int, dict[str, float]], Written]] = {
    "viscous_friction": _viscous,
    "quadratic_drag": _drag,
    "coulomb_friction": _coulomb,
    "asymmetric_friction": _asymmetric,
    "armature": _armature,
    "joint_spring": _spring,
    "controller_gain": _gains,
    "torque_constant": _torque_constant,
    "torque_saturation": _saturation,
    "command_delay": _delay,
    "inertial_parameters": _inertial,
    "payload": _payload,
    "base_tilt": _tilt,
}


# -- reading and stepping


def read_effects(path: Path) -> Patched:
    """Read ``effects.json``.

    Raises:
        SpecError: a field that is unknown, missing, or means nothing.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise SpecError("too large", path=path, expected=f"at most {_MAX_BYTES} bytes")
    try:
        data = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise SpecError(f"not JSON: {error}", path=path) from None

    def need(good: bool, where: str, expected: str, value: object = None) -> None:
        if not good:
            raise SpecError(
                "not a list of effects", path=path, where=where, value=value, expected=expected
            )

    need(isinstance(data, dict) and data.get("schema") == 1, "schema", "1")
    joints = data.get("joints")
    need(
        isinstance(joints, list) and bool(joints) and all(isinstance(j, str) for j in joints),
        "joints",
        "names of joints",
    )
    listed = data.get("effects")
    need(isinstance(listed, list) and len(listed) <= _MAX_EFFECTS, "effects", "a list")
    found = []
    for i, item in enumerate(listed):
        here = f"effects.{i}"
        need(isinstance(item, dict), here, "a table")
        name, joint, values = item.get("effect"), item.get("joint"), item.get("values")
        need(name in catalogue(), f"{here}.effect", "an effect of the catalogue", name)
        need(joint is None or joint in joints, f"{here}.joint", "one of joints, or null", joint)
        robot = catalogue()[name].scope == "robot"
        need(robot == (joint is None), f"{here}.joint", "null for the whole robot's effects")
        need(isinstance(item.get("in_model"), bool), f"{here}.in_model", "true or false")
        known = {p.name for p in catalogue()[name].parameters}
        need(isinstance(values, dict) and set(values) <= known, f"{here}.values", str(known))
        for key, value in values.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            need(number and math.isfinite(value), f"{here}.values.{key}", "a finite number", value)
        if not item["in_model"]:
            need(set(values) == known, f"{here}.values", str(known))
        found.append(
            AppliedEffect(name, joint, {k: float(v) for k, v in values.items()}, item["in_model"])
        )
    return Patched(tuple(joints), tuple(found))


def stepped_beside(patched: Patched) -> tuple[AppliedEffect, ...]:
    """Effects that the row simulator applies: those beside the model, and delays.

    MuJoCo's delay lines start at a command of zero, a recording does not: delays are taken out of
    the model that is stepped (:func:`without_delays`) and applied to the commands.
    """
    delays = tuple(e for e in patched.effects if e.in_model and e.effect == "command_delay")
    return patched.beside + delays


def without_delays(realization: Realization, patched: Patched) -> Realization:
    """The realization with the delay lines of :func:`stepped_beside` taken out."""
    delayed = {
        e.joint: e.values["delay"]
        for e in patched.effects
        if e.in_model and e.effect == "command_delay"
    }
    if not delayed:
        return realization
    spec = realization.spec.copy()
    for actuator in spec.actuators:
        if actuator.target in delayed and actuator.delay > 0.0:
            left = float(actuator.delay) - delayed[actuator.target]
            # MJCF is written with six digits.
            actuator.delay = left if left > 1e-5 * float(actuator.delay) else 0.0
            if actuator.delay == 0.0:
                actuator.nsample = 0
    return Realization(
        name=realization.name,
        path=realization.path,
        spec=spec,
        model=compiled(spec)[0],
        source=realization.source,
        twin=realization.twin,
    )


def fixed_values(
    effects: Sequence[AppliedEffect], joints: Sequence[str], rows: int
) -> EffectValues:
    """Parameters as (rows, joints) arrays; neutral where an effect is absent.

    Several entries of one effect at one joint add up in their switching parameters.
    """
    out: dict[str, dict[str, FloatArray]] = {}
    for e in effects:
        law = catalogue()[e.effect]
        if e.effect not in out:
            out[e.effect] = {
                p.name: np.full(
                    (rows, len(joints)), p.starts[0] if p.neutral is None else p.neutral
                )
                for p in law.parameters
            }
        column: slice | int = slice(None) if e.joint is None else list(joints).index(e.joint)
        for p in law.parameters:
            value = e.values.get(p.name)
            if value is None:
                continue
            array = out[e.effect][p.name]
            array[:, column] = value if p.neutral is None else array[:, column] + value
    return out


def replay_patched(
    realization: Realization, patched: Patched, trials: Sequence[Trial], *, threads: int = 0
) -> list[Predicted]:
    """Open-loop predictions of whole trials, at their own stamps, as the sensors would read.

    Args:
        realization: loaded from the patched folder.
        patched: what stands beside it.
        trials: commands and first states are read, nothing else.

    Returns:
        Columns are ``patched.joints``, rows the trials' own states.

    Raises:
        RecordingError: a joint that the effects act on is not in a recording.
        SimulationError: a simulation diverged.
    """
    stepped = without_delays(realization, patched)
    out = []
    for trial in trials:
        missing = [j for j in patched.joints if j not in trial.joints]
        if missing:
            raise RecordingError(
                "a joint of the diagnosed model is not in the recording",
                path=trial.path,
                value=", ".join(missing),
                expected=", ".join(patched.joints),
            )
        segment = whole_segment(stepped, trial, patched.joints)
        predicted = _predict(segment, patched, threads)
        if not np.isfinite(predicted.position).all():
            raise SimulationError("the simulation diverged", path=trial.path)
        out.append(_as_measured(predicted, segment, trial, realization, patched.joints))
    return out


def _predict(segment: Segment, patched: Patched, threads: int) -> Predicted:
    """As the diagnosis predicts: with the error of the model's own step taken out."""
    values = fixed_values(stepped_beside(patched), patched.joints, 1)
    row = np.zeros(1, dtype=np.int64)
    coarse, fine = (
        RowSimulator([segment], patched.joints, threads=threads, refine=refine).simulate(
            row, values
        )[0]
        for refine in (1, REFINE)
    )
    if not np.isfinite(fine.position).all():
        return coarse
    return corrected(coarse, step_error(coarse, fine))


def _as_measured(
    predicted: Predicted,
    segment: Segment,
    trial: Trial,
    realization: Realization,
    joints: Sequence[str],
) -> Predicted:
    """At every state of the trial, doubled stamps too, and as its encoders count."""
    calibration = calibration_of(realization)
    sign = np.array([calibration[j].sign if j in calibration else 1.0 for j in joints])
    offset = np.array([calibration[j].offset if j in calibration else 0.0 for j in joints])
    at = np.clip(np.searchsorted(segment.time, trial.time), 0, len(segment.time) - 1)
    return Predicted(
        sign * (predicted.position[at] - offset),
        sign * predicted.velocity[at],
        sign * predicted.effort[at],
    )


def whole_segment(realization: Realization, trial: Trial, joints: Sequence[str]) -> Segment:
    """One segment from the first state of a trial to its last."""
    parts = _segments(realization, trial, 0, joints)
    if len(parts) == 1:
        return parts[0]
    kept = [np.concatenate([[True], np.diff(p.time) > 0]) for p in parts]
    for before, here, keep in zip(parts[:-1], parts[1:], kept[1:], strict=True):
        keep &= here.time > before.time[-1]

    def joined(name: str) -> Any:
        values = [getattr(p, name) for p in parts]
        if any(v is None for v in values):
            return None
        return np.concatenate([v[k] for v, k in zip(values, kept, strict=True)])

    return replace(parts[0], **{n: joined(n) for n in ("time", "position", "velocity", "effort")})


__all__ = [
    "EFFECTS_FILE",
    "AppliedEffect",
    "Patched",
    "effects_json",
    "read_effects",
    "replay_patched",
    "write_realization",
]  # fmt: skip
