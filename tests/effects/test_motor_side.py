"""With an elastic transmission, drive and friction act on the motor side.

The reference integrates the equations of motion of motor and link with tight tolerances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

STEP, SECONDS = 0.00025, 1.5
INERTIA, MASS, ARM, ARMATURE, DAMPING = 0.03, 0.5, 0.2, 0.01, 0.05
KP, KV, STIFFNESS, TIME = 30.0, 0.8, 60.0, 0.01
MODEL = (
    f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
    f'<inertial pos="0 0 -{ARM}" mass="{MASS}" diaginertia="0.01 0.01 0.01"/>'
    f'<joint name="j" axis="0 -1 0" armature="{ARMATURE}" damping="{DAMPING}"/></body></worldbody>'
    "<actuator>{drive}</actuator></mujoco>"
)
DRIVES = {
    "position": f'<position joint="j" kp="{KP}" kv="{KV}"/>',
    "effort": '<motor joint="j"/>',
}
LAWS: dict[str, Mapping[str, float]] = {
    "torque_constant": {"relative_error": 0.2},
    "torque_rolloff": {"inverse_knee": 0.2, "back_emf": 0.0},
    "asymmetric_friction": {"coulomb": 0.0, "offset": 0.6},
    "cogging": {"sine": 0.3, "cosine": 0.1, "harmonic": 7.0},
    "quadratic_drag": {"coefficient": 0.2},
    "viscous_friction": {"coefficient": 0.3},
}


def motor_effort(law: str, drive: float, angle: float, speed: float) -> tuple[float, float]:
    """Delivered drive torque and total torque on the motor (N*m), by each effect's formula."""
    p = LAWS.get(law, {})
    if law == "torque_constant":
        drive *= 1.0 + p["relative_error"]
    if law == "torque_rolloff":
        drive /= 1.0 + abs(drive) * p["inverse_knee"]
    others = {
        "asymmetric_friction": lambda: -p["offset"],
        "cogging": lambda: p["sine"] * np.sin(7 * angle) + p["cosine"] * np.cos(7 * angle),
        "quadratic_drag": lambda: -p["coefficient"] * speed * abs(speed),
        "viscous_friction": lambda: -p["coefficient"] * speed,
    }
    return drive, drive - DAMPING * speed + others.get(law, lambda: 0.0)()


def reference(law: str, mode: str, command: Callable[[float], float]) -> tuple[FloatArray, ...]:
    """(samples,) link position and delivered effort at every step."""
    link_inertia = 0.01 + MASS * ARM**2

    def delivered(t: float, angle: float, speed: float) -> tuple[float, float]:
        asked = command(t) if mode == "effort" else KP * (command(t) - angle) - KV * speed
        return motor_effort(law, asked, angle, speed)

    def slope(t: float, x: FloatArray) -> list[float]:
        q, v, angle, speed = x
        through = STIFFNESS * (angle - q) + TIME * STIFFNESS * (speed - v)
        gravity = -MASS * 9.81 * ARM * np.sin(q)
        pushed = delivered(t, angle, speed)[1]
        return [v, (gravity + through) / link_inertia, speed, (pushed - through) / ARMATURE]

    times = STEP * np.arange(round(SECONDS / STEP))
    found = solve_ivp(
        slope, (0.0, SECONDS), np.zeros(4), t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01
    )
    effort = [delivered(t, a, s)[0] for t, a, s in zip(times, found.y[2], found.y[3], strict=True)]
    return found.y[0], np.array(effort)


def simulated(law: str, mode: str, command: Callable[[float], float]) -> tuple[FloatArray, ...]:
    time: FloatArray = STEP * np.arange(round(SECONDS / STEP), dtype=np.float64)
    n = len(time)
    segment = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(MODEL.format(drive=DRIVES[mode])), mode=mode,
        start=0.0, time=time, position=np.zeros((n, 1)), velocity=None, effort=None,
        command_time=time, command=np.array([[command(t)] for t in time]),
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip
    hidden = {"joint_elasticity": {"compliance": 1.0 / STIFFNESS, "damping_time": TIME}}
    if law in LAWS:
        hidden[law] = dict(LAWS[law])
    values = {e: {k: np.full((1, 1), v) for k, v in p.items()} for e, p in hidden.items()}
    found = BatchSimulator([segment], ("j",), threads=1).simulate(np.array([0]), values)[0]
    return found.position[:, 0], found.effort[:, 0]


@pytest.mark.parametrize("mode", DRIVES)
@pytest.mark.parametrize("law", ["none", *LAWS])
def test_drive_effects_act_on_the_motor_of_an_elastic_joint(law: str, mode: str) -> None:
    size = 1.5 if mode == "effort" else 0.5

    def command(t: float) -> float:
        return float(size * np.sin(2.0 * np.pi * 1.1 * t))

    (q, effort), (want_q, want_effort) = (f(law, mode, command) for f in (simulated, reference))
    # The tolerance covers a first-order integrator with steps of 0.25 ms.
    assert np.abs(q - want_q).max() < 0.003 * np.ptp(want_q)
    assert np.abs(effort - want_effort)[1:].max() < 0.02 * np.ptp(want_effort)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_load_at_rest_presses_the_teeth_of_a_gear_with_backlash(side: float) -> None:
    gap, teeth = 0.04, 5e3
    # The servo holds the link's weight; the motor is half a gap away from the link.
    weight = side * MASS * 9.81 * ARM
    command = weight / teeth + side * gap / 2.0 + weight / KP
    time: FloatArray = STEP * np.arange(2000, dtype=np.float64)
    across = MODEL.replace(f'pos="0 0 -{ARM}"', f'pos="{side * ARM} 0 0"')
    segment = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(across.format(drive=DRIVES["position"])),
        mode="position", start=0.0, time=time, position=np.zeros((2000, 1)), velocity=None,
        effort=None, command_time=time, command=np.full((2000, 1), command),
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip
    values = {"gap": np.full((1, 1), gap), "tooth_compliance": np.full((1, 1), 1.0 / teeth)}
    (at_rest,) = BatchSimulator([segment], ("j",), threads=1).simulate(
        np.array([0]), {"backlash": values}
    )
    assert np.abs(at_rest.position).max() < 1e-4
