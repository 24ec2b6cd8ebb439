"""What the installed MuJoCo offers; no other module asks for its version.

MuJoCo 3.11 is the oldest that the package runs on. What came later has a substitute here that gives
the same result, or a requirement with an error that names the version.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import ModelError
from pytest_twin.trial import CommandMode

_VERSION = tuple(int(part) for part in re.findall(r"\d+", mujoco.__version__)[:2])

if importlib.util.find_spec("mujoco.batch") is not None:
    from mujoco.batch import Batch as Batch
    from mujoco.batch import SimulationError as RowError
else:
    from pytest_twin.realization.row_loop import RowError
    from pytest_twin.realization.row_loop import RowLoop as Batch

_SHIFTS = 1e-9 * np.outer(range(1, 20), [1.0, 0.7, 0.4])
"""(n, 3) displacements, m, at which a distance of MuJoCo 3.11 is measured again."""
BatchError: Any = RowError
"""Error of rows in which MuJoCo stopped; ``ids`` are these rows."""


def new_batch(model: mujoco.MjModel, rows: int, threads: int = 0) -> Any:
    """Simulations of one model: a ``mujoco.batch.Batch``, or the same motion by a plain loop."""
    return Batch(model, rows, threads)


def _member(enum: str, name: str) -> int:
    """Value of a member of an enum of MuJoCo; -1, which no field has, where it lacks the member."""
    return int(getattr(getattr(mujoco, enum, None), name, -1))


GAIN_PID = _member("mjtGain", "mjGAIN_PID")
DYN_PID = _member("mjtDyn", "mjDYN_PID")
SETPOINT_BITS: tuple[tuple[CommandMode, int], ...] = (
    ("position", max(0, _member("mjtCtrlInput", "mjINPUT_POS"))),
    ("velocity", max(0, _member("mjtCtrlInput", "mjINPUT_VEL"))),
    ("effort", max(0, _member("mjtCtrlInput", "mjINPUT_FF"))),
)
"""Quantity of a setpoint -> its bit in ``actuator_ctrlspec``; 0 before MuJoCo 3.12."""
NO_INPUT = max(0, _member("mjtCtrlInput", "mjINPUT_NONE"))
"""``actuator_ctrlspec`` of an actuator without input."""
HAS_CONTROL_INPUTS = hasattr(mujoco, "mjtCtrlInput")
"""Whether a ``dcmotor`` states its inputs, or has none, and there is a ``pid``."""


def set_to_pid(actuator: mujoco.MjsActuator, **fields: Any) -> None:
    """Make an actuator a ``pid``; only with :data:`HAS_CONTROL_INPUTS`."""
    actuator.set_to_pid(**fields)


def _tendon_type(model: mujoco.MjModel) -> NDArray[np.int64]:
    first = model.wrap_type[model.tendon_adr] if model.ntendon else np.zeros(0, dtype=int)
    return np.asarray(first != int(mujoco.mjtWrap.mjWRAP_JOINT), dtype=np.int64)


_LATER_FIELDS: Mapping[str, Callable[[mujoco.MjModel], NDArray[Any]]] = {
    "site_dataid": lambda model: np.full(model.nsite, -1),
    "tendon_type": _tendon_type,
    "key_plastic": lambda model: np.zeros((model.nkey, 0)),
    "jnt_springyield": lambda model: np.zeros(model.njnt),
    "tendon_springyield": lambda model: np.zeros(model.ntendon),
}


def model_field(model: mujoco.MjModel, name: str) -> Any:
    """A field of a model; where MuJoCo lacks it, as a newer MuJoCo has it for the same model."""
    value = getattr(model, name, None)
    return _LATER_FIELDS[name](model) if value is None else value


def geom_distance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geoms: tuple[int, int],
    bound: float,
    ends: FloatArray | None = None,
) -> float:
    """Signed distance of two geoms, m; ``bound`` where they are further apart.

    MuJoCo 3.11 returns 0 for up to 3 % of the poses of boxes and meshes that are far apart. There,
    an exact 0 is measured again with the first geom moved by nanometres: that gave coal's distance
    in all 151 of 15,000 drawn poses.

    Args:
        data: state after ``mj_kinematics``.
        ends: (6,) nearest points, which are written.
    """
    distance = float(mujoco.mj_geomDistance(model, data, *geoms, bound, ends))
    position = data.geom_xpos[geoms[0]]
    for shift in _SHIFTS if _VERSION < (3, 17) else ():
        if distance != 0.0:
            break
        before = position.copy()
        position += shift
        distance = float(mujoco.mj_geomDistance(model, data, *geoms, bound, ends))
        position[:] = before
    return distance


def frame_scale(frame: mujoco.MjsFrame) -> Any:
    """(3,) factors of a ``frame`` element on its content; 1 in a MuJoCo without them."""
    return getattr(frame, "scale", np.ones(3))


def check_meaning(model: mujoco.MjModel) -> None:
    """Refuse a model that a newer MuJoCo simulates with another meaning of the same file.

    The gains of a controller in a ``dcmotor`` are volts before MuJoCo 3.12, torques since.

    Raises:
        ModelError: such a motor, with its name.
    """
    if _VERSION >= (3, 12):
        return
    motors = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_DCMOTOR)
    controlled = motors & model.actuator_gainprm[:, 4:9].any(axis=1)
    for actuator in np.flatnonzero(controlled):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, int(actuator))
        raise ModelError(
            "MuJoCo 3.12 changed what the controller of a dcmotor means",
            where=f"actuator '{name or actuator}'",
            value=f"MuJoCo {mujoco.__version__}",
            expected="a dcmotor without controller, or gains as torques (times K/R) and "
            "pip install 'mujoco>=3.12'",
        )


def version_advice(words: str) -> str:
    """Advice to append to a refusal of a model by MuJoCo; empty where its version does not matter.

    Args:
        words: message of MuJoCo.
    """
    if "dcmotor" in words and "keyword" in words and _VERSION >= (3, 12):
        return (
            "; since MuJoCo 3.12 the inputs of a dcmotor are pos, vel, ff and voltage, and its "
            "gains torques: times K/R"
        )
    unknown = re.search(r"schema violation|unrecognized|invalid keyword", words, re.IGNORECASE)
    if unknown and _VERSION < (4, 0):
        return (
            f"; MuJoCo {mujoco.__version__} is installed: if a newer one has it, "
            "pip install 'mujoco>=4'"
        )
    return ""
