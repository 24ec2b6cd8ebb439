"""Apply fits, controllers and payloads to a :class:`mujoco.MjSpec`."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import TwinError
from pytest_twin.realization import inertia, mjcf
from pytest_twin.twin import Patch, Payload, Pose

Refuse = Callable[..., TwinError]
"""Creates an error from a dotted field, the problem, and ``value``, ``unit``, ``expected``."""
Vector = NDArray[np.float64]


def apply_fit(
    spec: mujoco.MjSpec,
    patches: Mapping[str, Mapping[str, Patch]],
    option: Patch,
    *,
    refuse: Refuse,
) -> None:
    """Set identified parameters in ``spec``.

    Args:
        spec: changed in place.
        patches: ``joint``, ``actuator``, ``body``, ``geom`` or ``pair`` -> element -> attribute ->
            value.
        option: attribute of the simulation options -> value.

    Raises:
        TwinError: the error of ``refuse``, for an element or attribute that does not exist.
    """
    body_inertia = _BodyInertia(spec)
    for family, elements in patches.items():
        for name, patch in elements.items():
            here = f"fit.{family}.{name}"
            if family == "body":
                body = _find(spec.bodies, name, "body", here, refuse)
                _patch_body(body, patch, body_inertia, here, refuse)
            elif family == "joint":
                joint = _find(spec.joints, name, "joint", here, refuse)
                _patch_joint(joint, patch, here, refuse)
            elif family == "actuator":
                patch_actuator(spec, name, patch, where=here, refuse=refuse)
            elif family == "geom":
                geom = _find(spec.geoms, name, "geom", here, refuse)
                if "size" in patch:
                    body_inertia.keep(geom.parent)
                for attribute, value in patch.items():
                    _set(geom, attribute, value, f"{here}.{attribute}", refuse)
            elif family == "pair":
                pair = _find(spec.pairs, name, "contact pair", here, refuse)
                for attribute, value in patch.items():
                    _set(pair, attribute, value, f"{here}.{attribute}", refuse)
            else:
                raise refuse(
                    "fit",
                    "unknown table",
                    value=family,
                    expected="body, joint, actuator, geom or pair",
                )
    for attribute, value in option.items():
        _set(spec.option, attribute, value, f"fit.option.{attribute}", refuse)


def keep_inertia(spec: mujoco.MjSpec, bodies: Iterable[mujoco.MjsBody]) -> None:
    """Write the inertia of bodies, so that other sizes of their geoms do not change it."""
    body_inertia = _BodyInertia(spec)
    for body in bodies:
        body_inertia.keep(body)


def place_base(spec: mujoco.MjSpec, base: Pose, *, refuse: Refuse, where: str) -> None:
    """Set the pose of the robot's base to the calibrated one.

    Raises:
        TwinError: the model does not have exactly one base, which is a child of the world with
            joints on it or below it.
    """
    carriers = [body for body in spec.worldbody.bodies if body.joints or carries_joints(body)]
    free = mujoco.mjtJoint.mjJNT_FREE
    fixed = [body for body in carriers if all(joint.type != free for joint in body.joints)]
    # A free body next to an arm is an object, not a second robot.
    found = fixed or carriers
    if len(found) != 1 or found[0].frame is not None:
        raise refuse(
            where,
            "the model has no single base to place",
            value=", ".join(body.name for body in found) or None,
            expected="one child of the world with joints on it or below it",
        )
    found[0].pos = base.position
    found[0].quat = base.quaternion
    found[0].alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def carries_joints(body: mujoco.MjsBody) -> bool:
    """Whether a body below this one has a joint."""
    waiting = list(body.bodies)
    while waiting:
        child = waiting.pop()
        if child.joints:
            return True
        waiting.extend(child.bodies)
    return False


def apply_payload(
    spec: mujoco.MjSpec, bodies: Mapping[str, Payload], *, where: str, refuse: Refuse
) -> None:
    """Attach rigid loads to bodies: combine mass, centre of mass and inertia (parallel axes)."""
    body_inertia = _BodyInertia(spec)
    for name, payload in bodies.items():
        body = _find(spec.bodies, name, "body", f"{where}.{name}", refuse)
        mass, com, moments = body_inertia.of(body)
        total = mass + payload.mass
        if total <= 0:
            continue
        added_com = np.array(payload.com)
        both = (mass * com + payload.mass * added_com) / total
        moments = moments + inertia.point_inertia(mass, com - both)
        added = inertia.tensor(payload.inertia) + inertia.point_inertia(
            payload.mass, added_com - both
        )
        inertia.write(body, total, both, moments + added)


class _BodyInertia:
    """Mass, centre of mass and inertia of bodies, stated by the model or computed from geoms.

    Values from geoms are known only after compilation.
    """

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self._spec = spec
        self._model: mujoco.MjModel | None = None

    def of(self, body: mujoco.MjsBody) -> tuple[float, Vector, Vector]:
        """Mass [kg], (3,) com in the body's frame [m], (3, 3) inertia about com [kg*m^2].

        The axes are those of the body.
        """
        if self._model is None:
            self._model, _ = mjcf.compile_spec(self._spec)
            self._make_explicit(self._model)
        return _compiled_inertia(self._model, body.name)

    def keep(self, body: mujoco.MjsBody) -> None:
        """Write the inertia of a body, so that another surface of it does not change its mass."""
        if not body.explicitinertial and body.name not in ("", "world"):
            inertia.write(body, *self.of(body))

    def _make_explicit(self, model: mujoco.MjModel) -> None:
        """Write explicit inertias, so that the compiler does not recompute or scale them."""
        compiler = self._spec.compiler
        derived = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        if not derived and compiler.settotalmass <= 0:
            return
        for body in self._spec.bodies:
            if body.name != "world" and _body_id(model, body.name) >= 0:
                inertia.write(body, *_compiled_inertia(model, body.name))
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        compiler.settotalmass = -1.0


def _body_id(model: mujoco.MjModel, name: str) -> int:
    return int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))


def _compiled_inertia(model: mujoco.MjModel, name: str) -> tuple[float, Vector, Vector]:
    return inertia.compiled_inertia(model, _body_id(model, name))


def _patch_body(
    body: mujoco.MjsBody, patch: Patch, body_inertia: _BodyInertia, where: str, refuse: Refuse
) -> None:
    known = ("mass", "com", "inertia", "pos", "quat")
    _check_names(patch, known, where, refuse)
    if "pos" in patch:
        body.pos = patch["pos"]
    if "quat" in patch:
        body.quat = patch["quat"]
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if not {"mass", "com", "inertia"} & set(patch):
        return
    mass, com, moments = body_inertia.of(body)
    if "mass" in patch:
        mass = float(patch["mass"])  # type: ignore[arg-type]
    if "com" in patch:
        com = np.array(patch["com"], dtype=float)
    if "inertia" in patch:
        moments = inertia.tensor(patch["inertia"])  # type: ignore[arg-type]
    inertia.write(body, mass, com, moments)


_JOINT_ANGLES = ("range", "ref", "springref")
_JOINT = [
    "damping",
    "armature",
    "frictionloss",
    "stiffness",
    "springref",
    "ref",
    "range",
    "actfrcrange",
    "pos",
    "axis",
]


def _patch_joint(joint: mujoco.MjsJoint, patch: Patch, where: str, refuse: Refuse) -> None:
    _check_names(patch, _JOINT, where, refuse)
    degrees = joint.compiler.degree and joint.type != mujoco.mjtJoint.mjJNT_SLIDE
    for attribute, value in patch.items():
        # MuJoCo converts these from the unit of the file; a fit is always in rad.
        if degrees and attribute in _JOINT_ANGLES:
            value = np.rad2deg(value).tolist()
        _set(joint, attribute, value, f"{where}.{attribute}", refuse)
    if "range" in patch:
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    if "actfrcrange" in patch:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE


_ACTUATOR = [
    "kp",
    "kv",
    "ki",
    "dampratio",
    "timeconst",
    "delay",
    "gear",
    "ctrlrange",
    "forcerange",
    "armature",
    "damping",
    "gainprm",
    "biasprm",
    "dynprm",
]


def patch_actuator(
    spec: mujoco.MjSpec, name: str, patch: Patch, *, where: str, refuse: Refuse
) -> None:
    """Set gains and ranges of one actuator.

    ``kp``, ``kv``, ``dampratio`` and ``timeconst`` are the attributes of MJCF's ``position`` and
    ``intvelocity``; ``kv`` also that of ``velocity`` and ``damper``; ``kp``, ``ki`` and ``kv`` also
    those of ``pid``. ``kp`` turns a motor into a position servo: its control becomes a joint
    position within the joint's range, and its force limit stays. Other actuators have no gains.
    """
    actuator = _find(spec.actuators, name, "actuator", where, refuse)
    _check_names(patch, _ACTUATOR, where, refuse)
    if patch.get("kp") and _is_motor(actuator):
        _make_servo(spec, actuator, float(patch["kp"]))  # type: ignore[arg-type]
    for attribute, value in patch.items():
        here = f"{where}.{attribute}"
        if attribute in ("kp", "kv", "ki", "dampratio", "timeconst"):
            _set_gain(actuator, attribute, float(value), here, refuse)  # type: ignore[arg-type]
        else:
            _set(actuator, attribute, value, here, refuse)
    if "ctrlrange" in patch:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    if "forcerange" in patch:
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def _set_gain(
    actuator: mujoco.MjsActuator, gain: str, value: float, where: str, refuse: Refuse
) -> None:
    if gain == "timeconst" and actuator.dyntype in (
        mujoco.mjtDyn.mjDYN_FILTER,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    ):
        actuator.dynprm[0] = value
    elif gain == "kp" and _is_servo(actuator):
        actuator.gainprm[0] = value
        actuator.biasprm[1] = -value
    elif gain in ("kv", "dampratio") and _is_servo(actuator):
        # In MuJoCo, a positive third bias parameter is a damping ratio.
        actuator.biasprm[2] = value if gain == "dampratio" else -value
    elif gain == "kv" and _is_velocity_servo(actuator):
        actuator.gainprm[0] = value
        actuator.biasprm[2] = -value
    elif gain == "kv" and _is_damper(actuator):
        actuator.gainprm[2] = -value
    else:
        raise refuse(
            where,
            "this actuator has no such gain",
            value=gain,
            expected="a gain of its kind: kp of a position servo, kv of a servo or damper",
        )


def _is_motor(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force of the actuator equals its control and acts on one joint."""
    return bool(
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
    )


def _make_servo(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, kp: float) -> None:
    least, most = sorted(float(bound) * actuator.gainprm[0] for bound in actuator.ctrlrange)
    bounded = actuator.ctrllimited != mujoco.mjtLimited.mjLIMITED_FALSE and least < most
    if bounded and not actuator.forcerange[0] < actuator.forcerange[1]:
        # The control range of a motor is a limit of its force.
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [least, most]
    actuator.set_to_position(kp=kp)
    joint = spec.joint(actuator.target)
    lower, upper = (float(bound) for bound in joint.range) if joint is not None else (0.0, 0.0)
    if lower < upper:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.ctrlrange = [lower, upper]
    else:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _is_servo(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force is kp (u - q) - kv v, as for MJCF's ``position`` and ``intvelocity``."""
    return bool(
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
        and actuator.gainprm[0] == -actuator.biasprm[1]
        and actuator.gainprm[0] != 0
    )


def _is_velocity_servo(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force is kv (u - v), as for MJCF's ``velocity``."""
    return bool(
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
        and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and actuator.biasprm[1] == 0
        and actuator.gainprm[0] == -actuator.biasprm[2]
        and actuator.gainprm[0] != 0
    )


def _is_damper(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force is -kv u v, as for MJCF's ``damper``."""
    return bool(
        actuator.gaintype == mujoco.mjtGain.mjGAIN_AFFINE
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and not actuator.gainprm[:2].any()
        and actuator.gainprm[2] != 0
    )


def _set(element: Any, attribute: str, value: Any, where: str, refuse: Refuse) -> None:
    try:
        current = getattr(element, attribute)
    except AttributeError:
        raise refuse(
            where,
            "no such attribute",
            value=attribute,
            expected="an attribute that MJCF gives this element",
        ) from None
    if isinstance(current, np.ndarray):
        values = [float(v) for v in np.atleast_1d(value)]
        if len(values) > len(current):
            raise refuse(where, "too many numbers", value=value, expected=f"at most {len(current)}")
        filled = current.copy()
        filled[: len(values)] = values
        setattr(element, attribute, filled)
    elif np.ndim(value):
        raise refuse(where, "a list where one number belongs", value=value, expected="one number")
    elif isinstance(current, int) and not isinstance(current, bool):
        if value != int(value):
            raise refuse(where, "not a whole number", value=value, expected="a whole number")
        setattr(element, attribute, int(value))
    else:
        setattr(element, attribute, float(value))


def _check_names(patch: Patch, known: Iterable[str], where: str, refuse: Refuse) -> None:
    known = list(known)
    for name in patch:
        if name not in known:
            raise refuse(f"{where}.{name}", "no such attribute", expected=suggest(name, known))


def _find(elements: Iterable[Any], name: str, kind: str, where: str, refuse: Refuse) -> Any:
    by_name = {element.name: element for element in elements}
    if name not in by_name:
        raise refuse(where, f"the model has no such {kind}", expected=suggest(name, by_name))
    return by_name[name]


def suggest(name: str, known: Iterable[str]) -> str:
    """Names that are similar to ``name``, or else all known names, as text for a message."""
    names = sorted(str(candidate) for candidate in known if candidate)
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.6)
    if close:
        return "perhaps " + " or ".join(f"'{candidate}'" for candidate in close)
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"one of {shown}" if names else "none: the model has none"
