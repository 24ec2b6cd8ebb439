"""Write effects that MJCF can express into the model."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.patched.native_contact import write_contact
from pytest_twin.effects import (
    actuation,
    contact,
    directional,
    friction,
    rigid_body,
    timing,
    transmission,
)
from pytest_twin.effects.base import ModelFields
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.effects.layout import Layout
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.realization import mjcf_file, patch
from pytest_twin.realization.inertia import compiled_inertia, six_components
from pytest_twin.realization.mjcf import compile_spec
from pytest_twin.twin import Payload, Twin

# A delay line holds this many steps beyond the delay itself.
_SPARE_SAMPLES = 3


class NativeWriter:
    """Writes effects into a spec, one after another, where MuJoCo has their equation."""

    def __init__(
        self,
        spec: mujoco.MjSpec,
        joints: Sequence[str],
        layout: Layout,
        contact: Callable[[], ContactGeoms],
        twin: Twin | None = None,
    ) -> None:
        """Write into ``spec``.

        Args:
            spec: changed in place.
            joints: names of the joints, in the order of the columns of parameters.
            layout: indices of these joints and of their drives.
            contact: returns the geoms that contact effects act on.
            twin: twin whose controllers and payloads are applied to the written model later.
        """
        self.spec, self.joints, self.layout, self._contact = spec, tuple(joints), layout, contact
        # Controllers overwrite gains and payloads add masses for each trial. Relative changes of
        # these have to be applied afterwards, so they stay out of the MJCF.
        self.fixed_gains = twin is None or not twin.controllers
        self.fixed_masses = twin is None or not twin.payloads
        self.model = compile_spec(spec)[0]

    @property
    def contact(self) -> ContactGeoms:
        """Geoms that contact effects act on."""
        return self._contact()

    def write(self, term: Term, values: Mapping[str, float]) -> list[AppliedEffect]:
        """Write an effect into the MJCF; a second entry holds what MJCF cannot express."""
        joint = None if term.joint < 0 else self.joints[term.joint]
        outside_mjcf = AppliedEffect(term.effect, joint, dict(values), is_in_mjcf=False)
        write = _NATIVE.get(term.effect)
        if write is None:
            return [outside_mjcf]
        before = self.spec.copy()
        try:
            written = write(self, term.joint, dict(values))
            if written is None:
                self.spec = before
                return [outside_mjcf]
            text, rest = written
            self.model = compile_spec(self.spec)[0]
        except (TwinError, ValueError, RuntimeError, mujoco.FatalError):
            # MJCF rejects the value, a negative damping for example.
            self.spec = before
            self.model = compile_spec(self.spec)[0]
            return [outside_mjcf]
        inside = {k: v for k, v in values.items() if k not in rest}
        out = [AppliedEffect(term.effect, joint, inside, is_in_mjcf=True, written=text)]
        if rest:
            neutral = {p.name: p.neutral or 0.0 for p in term.parameters}
            out.append(AppliedEffect(term.effect, joint, {**neutral, **rest}, is_in_mjcf=False))
        return out

    def write_friction_constraint(self, stepped: mujoco.MjModel) -> None:
        """Write the friction constraint of the model with which the findings were simulated."""
        by_name = {j.name: j for j in self.spec.joints}
        dofs = self.layout.dof_index
        for name, dof in zip(self.joints, dofs, strict=True):
            joint = by_name[name]
            joint.solref_friction[:] = stepped.dof_solref[dof]
            joint.solimp_friction[:] = stepped.dof_solimp[dof]
        self.model = compile_spec(self.spec)[0]

    def text(self) -> str:
        """The MJCF."""
        return mjcf_file.with_exact_inertia(self.spec, self.model)

    # -- helpers of the laws below

    def refuse(self, where: str, problem: str, **details: Any) -> SpecError:
        """An error to raise; :meth:`write` then leaves the effect out of the MJCF."""
        return SpecError(problem, where=where, **details)

    def fit(self, family: str, name: str, values: Mapping[str, Any]) -> None:
        """Set attributes of one element like ``fit`` of a ``twin.yaml``."""
        patch.apply_fit(self.spec, {family: {name: values}}, {}, refuse=self.refuse)

    def joint_index(self, joint: int) -> tuple[str, int, int]:
        """Name, joint id and dof of a column."""
        return (
            self.joints[joint],
            int(self.layout.joint_ids[joint]),
            int(self.layout.dof_index[joint]),
        )

    def actuator_name(self, joint: int) -> str | None:
        """Name of the drive of a column, None without one."""
        at = int(self.layout.actuator[joint])
        if at < 0:
            return None
        return mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, at) or None

    def body_name(self, joint: int) -> str:
        """Name of the body that a column moves."""
        at = int(self.layout.body_index[joint])
        return str(mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_BODY, at))


Written = tuple[str, dict[str, float]] | None
"""Description of the changed MJCF elements, and the parameters that MJCF cannot express; None if it
cannot express the effect."""


def _write_viscous(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    total = float(w.model.dof_damping[dof]) + values["coefficient"]
    if total < 0.0:
        return None
    _add_damping(w, name, 0, values["coefficient"])
    return f"joint '{name}' damping", {}


def _write_directional_viscous(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    written = _write_viscous(w, joint, values)
    return None if written is None else (written[0], {"difference": values["difference"]})


def _add_damping(w: NativeWriter, name: str, order: int, value: float) -> None:
    joint = next(j for j in w.spec.joints if j.name == name)
    poly = np.array(joint.damping, dtype=float)
    poly[order] += value
    joint.damping = poly


def _write_drag(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    if values["coefficient"] + float(w.model.dof_dampingpoly[dof, 0]) < 0.0:
        return None
    _add_damping(w, name, 1, values["coefficient"])
    return f"joint '{name}' damping, second coefficient", {}


def _write_dry_friction(w: NativeWriter, joint: int, level: float) -> str:
    name, _, dof = w.joint_index(joint)
    total = max(float(w.model.dof_frictionloss[dof]) + level, 0.0)
    w.fit("joint", name, {"frictionloss": total})
    return f"joint '{name}' frictionloss"


def _write_coulomb(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    return _write_dry_friction(w, joint, values["coulomb"]), {}


def _write_asymmetric(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    return _write_dry_friction(w, joint, values["coulomb"]), {"offset": values["offset"]}


def _write_armature(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, _, dof = w.joint_index(joint)
    total = float(w.model.dof_armature[dof]) + values["inertia"]
    if total < 0.0:
        return None
    w.fit("joint", name, {"armature": total})
    return f"joint '{name}' armature", {}


def _write_spring(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name, index, _ = w.joint_index(joint)
    address = int(w.layout.qpos_index[joint])
    total = float(w.model.jnt_stiffness[index]) + values["stiffness"]
    if total <= 0.0:
        return None
    rest = float(w.model.qpos_spring[address]) + values["preload"] / total
    w.fit("joint", name, {"stiffness": total, "springref": rest})
    return f"joint '{name}' stiffness and springref", {}


def _write_gains(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains:
        return None
    at = int(w.layout.actuator[joint])
    stiffness, damping = 1.0 + values["stiffness_error"], 1.0 + values["damping_error"]
    gain, bias = w.model.actuator_gainprm[at].copy(), w.model.actuator_biasprm[at].copy()
    gain[0] *= damping if w.layout.servo[joint] == "velocity" else stiffness
    bias[1] *= stiffness
    bias[2] *= damping
    w.fit("actuator", name, {"gainprm": gain.tolist(), "biasprm": bias.tolist()})
    return f"actuator '{name}' gains", {}


def _write_torque_constant(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains:
        return None
    at, factor = int(w.layout.actuator[joint]), 1.0 + values["relative_error"]
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


def _write_saturation(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or not w.fixed_gains or values["inverse_limit"] <= 0.0:
        return None
    at = int(w.layout.actuator[joint])
    limit = 1.0 / values["inverse_limit"] / abs(float(w.layout.gear[joint]))
    ends = np.array([-limit, limit])
    if w.model.actuator_forcelimited[at]:
        ends = np.clip(w.model.actuator_forcerange[at], -limit, limit)
    if ends[0] >= ends[1]:
        return None
    w.fit("actuator", name, {"forcerange": ends.tolist()})
    return f"actuator '{name}' forcerange", {}


def _write_delay(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None:
        return None
    actuator = w.spec.actuator(name)
    total = float(actuator.delay) + values["delay"]
    actuator.delay = total
    actuator.nsample = math.ceil(total / float(w.model.opt.timestep)) + _SPARE_SAMPLES
    actuator.interp = 1
    return f"actuator '{name}' delay", {}


def _write_lag(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    name = w.actuator_name(joint)
    if name is None or values["of_setpoint"] == 0.0:
        return None
    actuator = w.spec.actuator(name)
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return None
    actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    actuator.dynprm[0] = values["time_constant"]
    return f"actuator '{name}' filtered activation", {}


def _write_inertial(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    if not w.fixed_masses:
        return None
    layout, body = w.layout, w.body_name(joint)
    index = int(layout.body_index[joint])
    fields = ModelFields.neutral(np.zeros((1, 3)), 1)
    link = rigid_body.InertialParameters()
    stated = {p.name: values.get(p.name, 0.0) for p in link.parameters}
    link.fields(fields, {k: np.full((1, 1), v) for k, v in stated.items()})
    mass, _, tensor = compiled_inertia(w.model, index)
    (heavier,), (wider,) = fields.mass_scale[0], fields.inertia_scale[0]
    changed: dict[str, Any] = {
        "mass": mass * heavier,
        "inertia": list(six_components(tensor * wider)),
    }
    if fields.center_moves.any():
        by = fields.center_radial[0], fields.center_tangential[0]
        (moved,) = layout.center_shift(*by, np.array([joint]))
        changed["com"] = (w.model.body_ipos[index] + moved).tolist()
    w.fit("body", body, changed)
    return f"body '{body}' mass, inertia and centre", {}


def _write_payload(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    del joint
    last = len(w.joints) - 1
    body = w.body_name(last)
    model, at = w.model, int(w.layout.joint_ids[last])
    place = np.array([[values.get(k, 0.0) for k in ("distance", "sideways", "across")]])
    center = model.jnt_pos[at] + w.layout.to_link_frame(place, np.array([last]))[0]
    index = int(w.layout.body_index[last])
    if not w.fixed_masses or float(model.body_mass[index]) + values["mass"] <= 1e-6:
        return None
    x, y, z = (float(c) for c in center)
    payload = Payload(values["mass"], (x, y, z))
    patch.apply_payload(w.spec, {body: payload}, where="payload", refuse=w.refuse)
    return f"body '{body}' mass, centre and inertia", {}


def _write_tilt(w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    del joint
    fields = ModelFields.neutral(np.array([w.model.opt.gravity]), 1)
    rigid_body.BaseTilt().fields(fields, {k: np.full((1, 1), v) for k, v in values.items()})
    w.spec.option.gravity = fields.gravity[0]
    return "option gravity", {}


def _write_contact(effect: str, w: NativeWriter, joint: int, values: dict[str, float]) -> Written:
    del joint
    text = write_contact(w.spec, w.contact, effect, values)
    return None if text is None else (text, {})


_NATIVE: Mapping[str, Callable[[NativeWriter, int, dict[str, float]], Written]] = {
    friction.ViscousFriction.id: _write_viscous,
    directional.DirectionalViscousFriction.id: _write_directional_viscous,
    friction.QuadraticDrag.id: _write_drag,
    friction.CoulombFriction.id: _write_coulomb,
    friction.AsymmetricFriction.id: _write_asymmetric,
    rigid_body.Armature.id: _write_armature,
    transmission.JointSpring.id: _write_spring,
    actuation.ControllerGain.id: _write_gains,
    actuation.TorqueConstant.id: _write_torque_constant,
    actuation.TorqueSaturation.id: _write_saturation,
    timing.CommandDelay.id: _write_delay,
    actuation.ActuatorLag.id: _write_lag,
    rigid_body.InertialParameters.id: _write_inertial,
    rigid_body.Payload.id: _write_payload,
    rigid_body.BaseTilt.id: _write_tilt,
    **{
        effect: functools.partial(_write_contact, effect)
        for effect in (
            contact.ContactOffset.id,
            contact.ContactStiffness.id,
            contact.ContactDamping.id,
            contact.ContactFriction.id,
        )
    },
}


def mjcf_expresses(effect: str) -> bool:
    """Whether MuJoCo has the equation of an effect, so that an MJCF file can contain it."""
    return effect in _NATIVE
