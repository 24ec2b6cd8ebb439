"""Delay lines of a model, applied as an effect on its commands.

MuJoCo's delay lines hold a fixed number of steps and start at a command of zero. They are too
short with a finer step, and a window that starts in motion lacks the earlier commands. The
simulated model has no delay lines; its commands are delayed instead.
"""

from __future__ import annotations

from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.effects.timing import CommandDelay
from pytest_twin.realization import Realization
from pytest_twin.realization.inputs import JOINT_TRANSMISSIONS
from pytest_twin.realization.mjcf import compile_spec


def effects_outside_mjcf(
    realization: Realization, patched: PatchedModel | None
) -> tuple[AppliedEffect, ...]:
    """Effects that the simulator applies: those that are not in the MJCF, and its delay lines."""
    model = realization.model
    late: dict[str, float] = {}
    for actuator in range(model.nactuator):
        delay = float(model.actuator_delay[actuator])
        if delay > 0.0 and int(model.actuator_trntype[actuator]) in JOINT_TRANSMISSIONS:
            joint = str(model.joint(int(model.actuator_trnid[actuator, 0])).name)
            late[joint] = max(delay, late.get(joint, 0.0))
    lines = (
        AppliedEffect(CommandDelay.id, joint, {"delay": delay}, is_in_mjcf=True)
        for joint, delay in late.items()
    )
    return (*(() if patched is None else patched.outside_mjcf), *lines)


def without_delays(realization: Realization) -> Realization:
    """The realization without the delay lines of :func:`effects_outside_mjcf`."""
    model = realization.model
    if not (model.actuator_delay > 0.0).any():
        return realization
    spec = realization.spec.copy()
    for actuator in spec.actuators:
        if int(actuator.trntype) in JOINT_TRANSMISSIONS:
            actuator.delay, actuator.nsample = 0.0, 0
    return Realization(
        name=realization.name,
        path=realization.path,
        spec=spec,
        model=compile_spec(spec)[0],
        source=realization.source,
        twin=realization.twin,
    )
