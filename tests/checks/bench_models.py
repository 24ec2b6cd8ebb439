"""Helpers of the dynamic checks: models with closed-form motion, and running of goldens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pytest_twin.checks.base import Check, Measure, Observation, Trace
from pytest_twin.golden import Golden
from pytest_twin.realization import Realization, load
from pytest_twin.units import parse_quantity

MASS = 2.0  # kg


def slider(
    *,
    stiffness: float = 0.0,
    damping: float = 0.0,
    friction: float = 0.0,
    actuator: str = "",
    timestep: float = 0.0005,
    integrator: str = "implicitfast",
    joint: str = "",
) -> str:
    """MJCF text of a 2 kg cart on a slide joint along x, perpendicular to gravity."""
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option timestep="{timestep}" integrator="{integrator}"/>
      <worldbody>
        <body name="cart">
          <joint name="x" type="slide" axis="1 0 0" stiffness="{stiffness}"
            damping="{damping}" frictionloss="{friction}" {joint}/>
          <geom name="cart" type="box" size=".1 .1 .1" mass="{MASS}"/>
        </body>
      </worldbody>
      <actuator>{actuator}</actuator>
    </mujoco>"""


def servo(stiffness: float, damping: float, extra: str = "") -> str:
    """MJCF element of a position servo on the slider."""
    return f'<position name="servo" joint="x" kp="{stiffness}" kv="{damping}" {extra}/>'


MOTOR = '<motor name="motor" joint="x"/>'


def load_text(folder: Path, text: str, name: str = "model.xml") -> Realization:
    """Write MJCF text to a file and load it."""
    path = folder / name
    path.write_text(text)
    return load(path)


def golden_of(check: Check, spec: Mapping[str, Any], path: Path = Path("g.yaml")) -> Golden:
    """A golden without recorded values; each field has its own line number."""
    lines: dict[str, int] = {}

    def walk(value: Any, field: str) -> None:
        lines[field] = len(lines) + 1
        if isinstance(value, Mapping):
            for key, inner in value.items():
                walk(inner, f"{field}.{key}" if field else str(key))

    walk({key: spec.get(key, {}) for key in ("target", "stimulus", "tolerance")}, "")
    return Golden(
        id="golden/g",
        path=path,
        kind=check.kind,
        title="",
        realizations=("mujoco",),
        criticality="critical",
        target=spec.get("target", {}),
        stimulus=spec.get("stimulus", {}),
        tolerance={
            name: parse_quantity(text, (check.tolerances[name],))
            for name, text in spec.get("tolerance", {}).items()
        },
        lines=lines,
    )


def observe(check: Check, golden: Golden, realization: Realization) -> Observation:
    """Run the golden's stimulus and return its observation."""
    return check.observe(golden, realization, lambda _: None)


def recorded(
    check: Check, spec: Mapping[str, Any], realization: Realization
) -> tuple[Golden, Trace | None]:
    """A golden with values recorded on ``realization``, and its trace."""
    golden = golden_of(check, spec)
    expected, trace = check.expect(golden, observe(check, golden, realization))
    return replace(golden, expected=expected), trace


def measures_on(
    check: Check, golden: Golden, trace: Trace | None, realization: Realization
) -> dict[str, Measure]:
    """The worst measure of each name when a recorded golden runs on another realization."""
    found: dict[str, Measure] = {}
    for measure in check.compare(golden, observe(check, golden, realization), trace):
        old = found.get(measure.name)
        if old is None or not measure.margin > old.margin:
            found[measure.name] = measure
    return found


def failed(measures: Mapping[str, Measure]) -> set[str]:
    """Names of the measures that did not pass."""
    return {name for name, measure in measures.items() if not measure.passed}
