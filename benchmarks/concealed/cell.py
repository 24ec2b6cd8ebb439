"""Random properties of real cells: servos, buses, motors, friction, and errors of the model.

A :class:`Cell` describes the control and logging of a robot. A :class:`Background` contains small
errors of the nominal model in addition to the hidden effects. Both are random for each case.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cell_friction import LAWS
from robots import Robot

BETWEEN = ("held", "interpolated", "ramped")
COMMAND_PERIODS = (0.002, 0.004, 0.005, 0.008, 0.01, 0.02)
"""Time between the commands of a log, s."""
SERVO_RATES = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
LOG_RATES = (20.0, 50.0, 100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)


@dataclass(frozen=True)
class Cell:
    """Control and logging of a robot.

    Attributes:
        between: interpolation of commands between two stamps; ``declared``: whether the recordings
            state it.
        command_period: time between logged commands, s.
        servo_period, servo_phase: period and phase of the servo's sampling, s.
        computing: delay of the computed effort, as a fraction of the servo's period.
        slope_cutoff: cutoff of the servo's low-pass on its differenced encoder, Hz; 0 if it has a
            velocity sensor.
        encoder: resolution of the servo's encoder, rad.
        transport: time from the stamp of a command to the servo, s.
        current_bandwidth, electrical: bandwidth of the current loop, Hz, and time constant of the
            winding, s; 0 for none.
        friction: friction law, a name of :data:`cell_friction.LAWS`; ``yield_at``: presliding
            displacement of its bristles, rad.
    """

    between: str
    declared: bool
    command_period: float
    servo_period: float
    servo_phase: float
    computing: float
    slope_cutoff: float
    encoder: float
    transport: float
    current_bandwidth: float
    electrical: float
    friction: str
    yield_at: float

    def facts(self) -> list[dict[str, Any]]:
        """Return properties that a diagnosis may report correctly besides hidden effects."""
        found: list[dict[str, Any]] = [
            {"effect": "control_period", "joint": None, "parameters": {"period": self.servo_period}}
        ]
        if self.slope_cutoff > 0.0:
            found.append(
                {"effect": "velocity_filter", "joint": None,
                 "parameters": {"time_constant": 0.5 / np.pi / self.slope_cutoff}}
            )  # fmt: skip
        late = self.transport + self.servo_period * (0.5 + self.computing)
        found.append({"effect": "command_delay", "joint": None, "parameters": {"delay": late}})
        if self.current_bandwidth > 0.0:
            lag = 0.5 / np.pi / self.current_bandwidth
            found.append(
                {"effect": "actuator_lag", "joint": None, "parameters": {"time_constant": lag}}
            )
        if self.friction != "set_valued":
            found.append(
                {"effect": "presliding_hysteresis", "joint": None,
                 "parameters": {"presliding_distance": self.yield_at}}
            )  # fmt: skip
        return found


def draw_cell(robot: Robot, rng: np.random.Generator) -> Cell:
    """Draw a cell for a robot."""
    between = str(rng.choice(BETWEEN, p=(0.35, 0.45, 0.2)))
    if robot.mode == "effort" and between == "ramped":
        between = "held"
    knows = bool(rng.random() < 0.3)
    motor = bool(rng.random() < 0.7)
    servo_period = 1.0 / float(rng.choice(SERVO_RATES))
    return Cell(
        between=between,
        declared=bool(rng.random() < 0.25),
        command_period=float(rng.choice(COMMAND_PERIODS)),
        servo_period=servo_period,
        servo_phase=float(rng.uniform(0.0, servo_period)),
        computing=float(rng.choice((0.0, 0.5, 1.0))),
        slope_cutoff=0.0 if knows else float(rng.uniform(40.0, 200.0)),
        encoder=float(2 * np.pi / rng.choice((2**14, 2**16, 2**19))),
        transport=float(rng.uniform(0.0, 1.5e-3)),
        current_bandwidth=float(rng.uniform(200.0, 800.0)) if motor else 0.0,
        electrical=float(rng.uniform(3e-4, 2e-3)) if motor else 0.0,
        friction=str(rng.choice(LAWS)),
        yield_at=float(10 ** rng.uniform(-4.3, -3.3)),
    )


def ideal(cell: Cell, step: float) -> Cell:
    """Return the cell with ideal servos and motors and stiff friction, with the same commands."""
    return Cell(cell.between, cell.declared, cell.command_period, step, 0.0, 0.0, 0.0, 0.0, 0.0,
                0.0, 0.0, "set_valued", 1e-4)  # fmt: skip


@dataclass
class Background:
    """Errors of the nominal model.

    Attributes:
        effects: effect -> joint index (or -1) -> parameters, as in :class:`plant.Hidden`.
        centers, origins: (joints, 3) m, errors of centres of mass and of joint origins.
    """

    effects: dict[str, dict[int, dict[str, float]]] = field(default_factory=dict)
    centers: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    origins: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def scaled(self, by: float) -> Background:
        """Return the same errors, scaled by a factor."""
        fixed = ("harmonic", "in_loop", "stribeck_velocity")
        effects = {
            e: {i: {k: v if k in fixed else by * v for k, v in p.items()} for i, p in at.items()}
            for e, at in self.effects.items()
        }
        return Background(effects, by * self.centers, by * self.origins)

    def without(self, taken: dict[str, dict[int, Any]]) -> Background:
        """Return the errors without effects that are hidden at the same joint."""
        effects = {
            e: {i: p for i, p in at.items() if i not in taken.get(e, {})}
            for e, at in self.effects.items()
        }
        return Background({e: at for e, at in effects.items() if at}, self.centers, self.origins)


def draw_background(robot: Robot, rng: np.random.Generator) -> Background:
    """Draw errors: inertias 1 to 3 %, friction 5 to 10 %, small ripple, a millimetre, a degree."""

    def off(low: float, high: float) -> float:
        return float(rng.choice((-1.0, 1.0)) * rng.uniform(low, high))

    effects: dict[str, dict[int, dict[str, float]]] = {
        "base_tilt": {-1: {"roll": np.radians(off(0.1, 0.7)), "pitch": np.radians(off(0.1, 0.7))}}
    }
    for i, j in enumerate(robot.joints):
        scale = j.effort / 6.0
        here: dict[str, dict[str, float]] = {
            "inertial_parameters": {"relative_error": off(0.01, 0.03)},
            "armature": {"inertia": off(0.01, 0.03) * j.armature},
            "viscous_friction": {"coefficient": off(0.05, 0.1) * j.damping},
            "coulomb_friction": {"coulomb": off(0.05, 0.1) * j.friction},
            "torque_constant": {"relative_error": off(0.003, 0.015)},
        }
        if rng.random() < 0.5:
            here["cogging"] = {
                "sine": off(0.002, 0.01) * scale, "cosine": off(0.0, 0.005) * scale,
                "harmonic": float(rng.choice((6, 8, 12, 16, 24))),
            }  # fmt: skip
        if rng.random() < 0.4:
            here["stribeck_friction"] = {
                "stiction_excess": rng.uniform(0.05, 0.1) * j.friction,
                "stribeck_velocity": float(rng.uniform(0.02, 0.1)),
            }
        if not j.slide:
            here["encoder_bias"] = {"bias": np.radians(off(0.1, 0.7)), "in_loop": 1.0}
        for effect, values in here.items():
            effects.setdefault(effect, {})[i] = values
    n = len(robot.joints)
    return Background(effects, rng.uniform(-1e-3, 1e-3, (n, 3)), rng.uniform(-1e-3, 1e-3, (n, 3)))
