"""Small robots and goldens for the tests of the checks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from pytest_twin.checks.base import Check, Measure
from pytest_twin.golden import Golden
from pytest_twin.realization import Realization, load
from pytest_twin.units import Quantity, parse_quantity

ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001"/>
  <worldbody>
    <body name="turret" pos="0 0 0.1">
      <joint name="pan" axis="0 0 1" range="-2 2" damping="0.5" armature="0.02"/>
      <geom name="turret" type="cylinder" size="0.05 0.04" mass="1"/>
      <body name="upper_arm" pos="0 0 0.08">
        <joint name="lift" axis="0 1 0" range="-1.5 1.5" damping="0.5" armature="0.02"/>
        <geom name="upper_arm" type="capsule" fromto="0 0 0.06 0 0 0.24" size="0.03" mass="0.8"/>
        <body name="forearm" pos="0 0 0.3">
          <joint name="elbow" axis="0 1 0" range="-2.2 2.2" damping="0.3" armature="0.01"/>
          <geom name="forearm" type="box" pos="0 0 0.1" size="0.025 0.02 0.08" mass="0.5"/>
          <body name="palm" pos="0 0 0.2">
            <geom name="palm" type="box" size="0.04 0.02 0.01" mass="0.1"/>
            <site name="tcp" pos="0 0 0.05" euler="0 0 0.3"/>
            <body name="left" pos="0.01 0 0.03">
              <joint name="left" type="slide" axis="1 0 0"
                range="0 0.03" damping="5" armature="0.2"/>
              <geom name="left" type="box" size="0.004 0.01 0.02" mass="0.02"/>
            </body>
            <body name="right" pos="-0.01 0 0.03">
              <joint name="right" type="slide" axis="-1 0 0"
                range="0 0.03" damping="5" armature="0.2"/>
              <geom name="right" type="box" size="0.004 0.01 0.02" mass="0.02"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <equality>
    <joint name="mimic" joint1="right" joint2="left" polycoef="0 1 0 0 0"/>
  </equality>
  <actuator>
    <position name="pan" joint="pan" kp="50" ctrlrange="-1.9 1.9" forcerange="-10 10"/>
    <motor name="lift" joint="lift" gear="20" ctrlrange="-1 1"/>
    <position name="elbow" joint="elbow" kp="30" ctrlrange="-2 2" forcerange="-5 5"/>
    <position name="grip" joint="left" kp="200" ctrlrange="0 0.03" forcerange="-8 8"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0.5 1.0 0.01 0.01"/>
  </keyframe>
</mujoco>
"""


def robot(folder: Path, text: str = ARM, name: str = "robot.xml") -> Realization:
    path = folder / name
    path.write_text(text)
    return load(path)


def golden(
    check: Check,
    *,
    target: Mapping[str, Any] | None = None,
    stimulus: Mapping[str, Any] | None = None,
    tolerance: Mapping[str, str] | None = None,
    expected: Mapping[str, Any] | None = None,
    lines: Mapping[str, int] | None = None,
) -> Golden:
    bounds: dict[str, Quantity] = {
        name: parse_quantity(text, (check.tolerances[name],))
        for name, text in (tolerance or {}).items()
    }
    return Golden(
        id="golden/spec",
        path=Path("golden/spec.yaml"),
        kind=check.kind,
        title="",
        realizations=("mujoco",),
        criticality="critical",
        target=target or {},
        stimulus=stimulus or {},
        tolerance=bounds,
        expected=expected,
        lines=lines or {},
    )


def from_first(check: Check, realization: Realization, index: int = 0) -> Golden:
    """The golden that the check proposes for the realization."""
    spec = check.first(realization)[index]
    return golden(
        check, target=spec["target"], stimulus=spec["stimulus"], tolerance=spec["tolerance"]
    )


def measure(check: Check, spec: Golden, realization: Realization) -> list[Measure]:
    """Run a golden and return its measures."""
    observation = check.observe(spec, realization, lambda fraction: None)
    return check.compare(spec, observation, None)


def record(check: Check, spec: Golden, realization: Realization) -> Golden:
    """The golden with the values that ``--twin-update`` would record."""
    import dataclasses

    expected, _ = check.expect(spec, check.observe(spec, realization, lambda fraction: None))
    return dataclasses.replace(spec, expected=expected)


def failed(measures: list[Measure]) -> list[Measure]:
    return [measure for measure in measures if not measure.passed]


def numbers(count: int, size: float = 1.0) -> st.SearchStrategy[list[float]]:
    return st.lists(
        st.floats(-size, size).map(lambda x: round(x, 3)), min_size=count, max_size=count
    )


def directions(count: int = 3) -> st.SearchStrategy[list[float]]:
    return numbers(count).filter(lambda v: sum(x * x for x in v) > 0.05)


# Shrinking of robots is slow and is skipped; a failing example is printed in full.
QUICK = settings(
    max_examples=25,
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def random_robots(draw: st.DrawFn) -> str:
    """MJCF of a tree of up to six bodies, each with zero to two joints and any inertia."""
    count = draw(st.integers(2, 6))
    parents = [-1] + [draw(st.integers(0, i - 1)) for i in range(1, count)]

    def words(values: list[float]) -> str:
        return " ".join(f"{x:g}" for x in values)

    def body(i: int) -> str:
        joints = ""
        kinds = draw(st.sampled_from([["hinge"], ["slide"], ["slide", "hinge"], []]))
        for k, kind in enumerate(kinds if i else kinds or ["hinge"]):
            joints += (
                f'<joint name="j{i}_{k}" type="{kind}" axis="{words(draw(directions()))}" '
                f'pos="{words(draw(numbers(3, 0.2)))}" range="-1 1.5" '
                f'ref="{draw(st.sampled_from([0, 0.2]))}"/>'
            )
        low = draw(st.floats(0.01, 0.1))
        inertial = (
            f'<inertial mass="{draw(st.floats(0.1, 5)):.3f}" pos="{words(draw(numbers(3, 0.3)))}" '
            f'quat="{words(draw(directions(4)))}" '
            f'diaginertia="{low:.4f} {1.1 * low:.4f} {1.5 * low:.4f}"/>'
        )
        children = "".join(body(c) for c in range(count) if parents[c] == i)
        return (
            f'<body name="b{i}" pos="{words(draw(numbers(3)))}" '
            f'quat="{words(draw(directions(4)))}">'
            f'{joints}{inertial}<site name="s{i}" pos="{words(draw(numbers(3, 0.2)))}" '
            f'quat="{words(draw(directions(4)))}"/>{children}</body>'
        )

    gravity = words(draw(numbers(3, 10)))
    return (
        f'<mujoco><compiler angle="radian" autolimits="true"/><option gravity="{gravity}"/>'
        f"<worldbody>{body(0)}</worldbody></mujoco>"
    )
