"""Draw effects to hide in a real machine's recordings or to remove from its model.

Each draw gives an effect under its name in the catalogue, the parameters that a diagnosis should
find, and either a change of the recordings or a falsified model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from injections import (
    Recorded,
    bent_encoder,
    biased_encoder,
    drifting_clock,
    late_drive,
    late_drive_of,
    late_states,
    misread_effort,
    scaled_encoder,
)  # fmt: skip
from real_models import Machine

Change = Callable[[Recorded], Recorded]
EFFORT_EFFECTS = ("effort_bias", "effort_scale")
"""Effects of the effort sensor, which do not influence the motion."""


@dataclass(frozen=True)
class Concealed:
    """One hidden effect.

    Attributes:
        effect, joint: catalogue name and joint; joint None for the whole robot.
        parameters: name -> value that a diagnosis should find, SI units.
        how: description of the change.
        change: function that changes a recording; None if the model is falsified.
        falsify: function that changes the model; None if the recordings are changed.
    """

    effect: str
    joint: str | None
    parameters: Mapping[str, float]
    how: str
    change: Change | None = None
    falsify: Callable[[Machine], Machine] | None = None


def _uniform(rng: np.random.Generator, low: float, high: float, *, signed: bool = False) -> float:
    """Round a value to four digits, so that a truth file states it exactly."""
    sign = float(rng.choice([-1.0, 1.0])) if signed else 1.0
    return sign * float(f"{rng.uniform(low, high):.4g}")


# Each of these functions draws one hidden effect of a machine at a joint. Its size is from about
# the background to ten times the background.


def sensor_delay(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a sensor delay: states have late stamps."""
    delay = _uniform(rng, 0.01, 0.05)
    return Concealed(
        "sensor_delay", None, {"delay": delay}, "states stamped late by the delay",
        change=lambda r: late_states(r, delay),
    )  # fmt: skip


def command_delay(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a command delay, of one joint if there are several."""
    if len(machine.joints) > 1:
        samples = int(rng.integers(1, 4))
        delay = 0.02005 * samples
        return Concealed(
            "command_delay", joint, {"delay": delay},
            f"commands of the joint are those of {samples} messages later",
            change=lambda r: late_drive_of(r, joint, samples),
        )  # fmt: skip
    delay = _uniform(rng, 0.01, 0.05)
    return Concealed(
        "command_delay", joint, {"delay": delay}, "commands stamped early by the delay",
        change=lambda r: late_drive(r, delay),
    )  # fmt: skip


def clock_drift(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a drift of the states' clock."""
    drift = _uniform(rng, 0.003, 0.012, signed=True)
    return Concealed(
        "clock_drift", None, {"drift": drift}, "stamps of states stretched by 1 / (1 - drift)",
        change=lambda r: drifting_clock(r, drift),
    )  # fmt: skip


def encoder_scale(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw an encoder scale, on positions and velocities."""
    error = _uniform(rng, 0.03, 0.1, signed=True)
    return Concealed(
        "encoder_scale", joint, {"scale_error": error}, "readings times 1 + scale_error",
        change=lambda r: scaled_encoder(r, joint, error),
    )  # fmt: skip


def encoder_bias(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw an encoder bias, which is not in the servo's feedback."""
    bias = _uniform(rng, 0.02, 0.1, signed=True)
    return Concealed(
        "encoder_bias", joint, {"bias": bias, "in_loop": 0.0}, "readings plus bias",
        change=lambda r: biased_encoder(r, joint, bias),
    )  # fmt: skip


def encoder_eccentricity(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw an encoder eccentricity, with one period per revolution."""
    amplitude, phase = _uniform(rng, 0.03, 0.08), _uniform(rng, 0.0, 6.283)
    parameters = {
        "sine": amplitude * float(np.cos(phase)), "cosine": amplitude * float(np.sin(phase)),
        "zeroed": 0.0,
    }  # fmt: skip
    return Concealed(
        "encoder_eccentricity", joint, parameters,
        f"readings plus {amplitude} sin(q + {phase})",
        change=lambda r: bent_encoder(r, joint, amplitude, phase),
    )  # fmt: skip


def effort_scale(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw an effort scale."""
    error = _uniform(rng, 0.15, 0.4, signed=True)
    return Concealed(
        "effort_scale", joint, {"scale_error": error}, "measured effort times 1 + scale_error",
        change=lambda r: misread_effort(r, joint, error, 0.0),
    )  # fmt: skip


def effort_bias(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw an effort bias."""
    bias = _uniform(rng, 5.0, 20.0, signed=True)
    return Concealed(
        "effort_bias", joint, {"bias": bias}, "measured effort plus bias",
        change=lambda r: misread_effort(r, joint, 0.0, bias),
    )  # fmt: skip


def payload(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a payload: the model's link is too light, or too heavy if a mass is removed."""
    body, true = machine.tool
    mass = round(true * _uniform(rng, 0.08, 0.3), 4)
    # The arm's mass is 0.1 m from the joint.
    parameters = {"mass": mass} if machine.mode == "effort" else {"mass": mass, "distance": 0.1}
    return Concealed(
        "payload", None, parameters, f"mass of {body} in the model less by the payload",
        falsify=lambda m: replace(m, mass={**m.mass, body: true - mass}),
    )  # fmt: skip


def base_tilt(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a base tilt: gravity of the model is rotated."""
    if machine.name == "emps":
        # The mass is 95 kg, so 1 mrad corresponds to 0.93 N.
        pitch = _uniform(rng, 0.006, 0.02, signed=True)
    else:
        pitch = _uniform(rng, 0.05, 0.15, signed=True)
    return Concealed(
        "base_tilt", None, {"roll": 0.0, "pitch": pitch},
        "gravity of the model pitched by minus that, the machine's base is level to it",
        falsify=lambda m: replace(m, tilt=(0.0, m.tilt[1] - pitch)),
    )  # fmt: skip


def controller_gain(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a servo stiffness error; the passive damping is right."""
    error = _uniform(rng, 0.15, 0.5, signed=True)

    def falsify(m: Machine) -> Machine:
        gains = {name: kp / (1.0 + error) for name, kp in m.controllers.items()}
        return replace(
            m.with_drive(joint, kp=m.drives[joint].kp / (1.0 + error)), controllers=gains
        )

    return Concealed(
        "controller_gain", joint, {"stiffness_error": error},
        "kp of the model divided by 1 + stiffness_error", falsify=falsify,
    )  # fmt: skip


def torque_constant(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a torque constant error: commanded efforts are logged too small or too large."""
    error = _uniform(rng, 0.08, 0.25, signed=True)

    def change(r: Recorded) -> Recorded:
        assert r.command.effort is not None
        return replace(r, command=replace(r.command, effort=r.command.effort / (1.0 + error)))

    return Concealed(
        "torque_constant", joint, {"relative_error": error},
        "logged efforts divided by 1 + relative_error", change=change,
    )  # fmt: skip


def _less(name: str, effect: str, parameter: str, low: float, high: float) -> Any:
    """Draw an effect whose value in the model is too small by a random fraction."""

    def draw(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
        true = float(getattr(machine.drives[joint], name))
        missing = float(f"{true * rng.uniform(low, high):.4g}")
        return Concealed(
            effect, joint, {parameter: missing}, f"{name} of the model less by {parameter}",
            falsify=lambda m: m.with_drive(joint, **{name: true - missing}),
        )  # fmt: skip

    return draw


def armature(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Draw a too large armature; at 50 Hz and with a stiff servo, a smaller one is not visible."""
    extra = float(f"{machine.drives[joint].armature * rng.uniform(3.0, 8.0):.4g}")
    return Concealed(
        "armature",
        joint,
        {"inertia": -extra},
        "armature of the model more by minus inertia",
        falsify=lambda m: m.with_drive(joint, armature=m.drives[joint].armature + extra),
    )


def asymmetric_friction(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
    """Remove the difference of friction between the directions from the model."""
    offset = machine.value("asymmetric_friction", "offset")
    return Concealed(
        "asymmetric_friction", joint, {"coulomb": 0.0, "offset": offset},
        "offset taken out of the model", falsify=lambda m: m.without("asymmetric_friction"),
    )  # fmt: skip


def _law_taken_away(effect: str) -> Any:
    """Remove a law that acts in addition to the MJCF model."""

    def draw(machine: Machine, joint: str, rng: np.random.Generator) -> Concealed:
        values = next(dict(v) for e, _, v in machine.beside if e == effect)
        if "inverse_knee" in values:
            values["knee"] = 1.0 / values.pop("inverse_knee")
        return Concealed(
            effect, joint, values, "the whole law taken out of the model",
            falsify=lambda m: m.without(effect),
        )  # fmt: skip

    return draw


DRAWS: Mapping[str, Callable[[Machine, str, np.random.Generator], Concealed]] = {
    "sensor_delay": sensor_delay, "command_delay": command_delay, "clock_drift": clock_drift,
    "encoder_scale": encoder_scale, "encoder_bias": encoder_bias,
    "encoder_eccentricity": encoder_eccentricity, "effort_scale": effort_scale,
    "effort_bias": effort_bias, "payload": payload, "base_tilt": base_tilt,
    "controller_gain": controller_gain, "torque_constant": torque_constant,
    "asymmetric_friction": asymmetric_friction,
    "viscous_friction": _less("damping", "viscous_friction", "coefficient", 0.25, 0.8),
    "coulomb_friction": _less("friction", "coulomb_friction", "coulomb", 0.4, 0.8),
    "armature": armature,
    "torque_rolloff": _law_taken_away("torque_rolloff"),
    "motor_load_friction": _law_taken_away("motor_load_friction"),
}  # fmt: skip
# Effects that can be hidden in each machine, in the order of a block. Effects without visible
# influence are left out: the zero of a slide, and a rotor that is light compared with its link.
CHOICES: Mapping[str, tuple[str, ...]] = {
    "emps": (
        "viscous_friction", "coulomb_friction", "payload", "torque_constant", "base_tilt",
        "command_delay", "encoder_scale", "asymmetric_friction", "effort_scale", "sensor_delay",
        "effort_bias", "clock_drift",
    ),
    "xl330": (
        "controller_gain", "payload", "command_delay", "base_tilt", "torque_rolloff",
        "encoder_scale", "encoder_bias", "motor_load_friction", "sensor_delay",
        "encoder_eccentricity", "viscous_friction", "clock_drift", "armature",
    ),
    "so101_pan": (
        "coulomb_friction", "controller_gain", "encoder_scale", "armature", "command_delay",
        "encoder_eccentricity", "viscous_friction", "clock_drift", "sensor_delay", "encoder_bias",
    ),
    "so101_flex": (
        "viscous_friction", "encoder_bias", "sensor_delay", "controller_gain", "coulomb_friction",
        "encoder_scale", "encoder_eccentricity", "armature", "clock_drift", "command_delay",
    ),
    "so101_roll": (
        "armature", "viscous_friction", "clock_drift", "encoder_bias", "command_delay",
        "coulomb_friction", "controller_gain", "encoder_scale", "sensor_delay",
        "encoder_eccentricity",
    ),
    "so101_wrist": (
        "controller_gain", "command_delay", "encoder_scale", "coulomb_friction", "sensor_delay",
        "viscous_friction", "encoder_bias", "clock_drift",
    ),
}  # fmt: skip
