"""Contact primitives compared with closed forms, and their failure on changed models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from bench_models import failed, golden_of, load_text, measures_on, observe, recorded
from scipy.integrate import solve_ivp

from pytest_twin.checks.contact import Contact
from pytest_twin.checks.contact_scene import SIZES
from pytest_twin.errors import SpecError
from pytest_twin.realization import scene

CHECK = Contact()
GRAVITY, MASS = 9.81, 0.2
BOX = {"shape": "box", "size": [0.02, 0.02, 0.02], "mass": "0.2 kg"}
BALL = {"shape": "sphere", "size": ["20 mm"], "mass": "0.2 kg"}
STIFF, DAMPED = 20_000.0, 40.0  # 1/s^2 and 1/s, of the table's contact
HARD = f'solref="-{STIFF:g} -{DAMPED:g}" solimp="0.9999 0.9999 0.001 0.5 2"'


def workcell(
    *,
    table: str = 'friction="0.6 0.005 0.0001"',
    pads: str = 'friction="0.8 0.005 0.0001"',
    timestep: float = 0.001,
    force: float = 10.0,
) -> str:
    """MJCF text of a table, a spherical tip on two slides above it, and a two-finger gripper."""
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option timestep="{timestep}" integrator="implicitfast" cone="elliptic"/>
      <worldbody>
        <geom name="table" type="box" size="1 1 .05" pos="0 0 -.05" {table}/>
        <body name="probe" pos="-.5 0 .12">
          <joint name="along" type="slide" axis="1 0 0" damping="2"/>
          <geom type="box" size=".01 .01 .01" mass=".1" contype="0" conaffinity="0"/>
          <body name="stem">
            <joint name="down" type="slide" axis="0 0 -1" range="-.2 .2" damping="20"/>
            <geom name="tip" type="sphere" size=".02" mass=".3" friction=".1 .005 .0001"/>
          </body>
        </body>
        <body name="left" pos="0 0 .5">
          <joint name="l" type="slide" axis="0 1 0" range="-.05 .05" damping="5"/>
          <geom name="left_pad" type="box" size=".01 .005 .02" pos="0 -.05 0" mass=".05" {pads}/>
        </body>
        <body name="right" pos="0 0 .5">
          <joint name="r" type="slide" axis="0 -1 0" range="-.05 .05" damping="5"/>
          <geom name="right_pad" type="box" size=".01 .005 .02" pos="0 .05 0" mass=".05" {pads}/>
        </body>
        <site name="grasp" pos="0 0 .5"/>
      </worldbody>
      <actuator>
        <position name="down" joint="down" kp="500" kv="20"/>
        <position name="l" joint="l" kp="2000" kv="20" forcerange="-{force} {force}"/>
        <position name="r" joint="r" kp="2000" kv="20" forcerange="-{force} {force}"/>
      </actuator>
    </mujoco>"""


def spec(
    primitive: str, pair: list[str], stimulus: dict[str, Any], **target: Any
) -> dict[str, Any]:
    tolerance = {
        "approach": {
            "onset_time": "1 ms",
            "position": "10 um",
            "orientation": "1 mrad",
            "penetration": "1 um",
            "normal_force": "10 mN",
        },
        "slide": {"friction": "0.5 %", "slip_force": "20 mN", "declared_friction": "0.5 %"},
        "release": {"rebound": "0.1 mm", "restitution": "0.5 %", "onset_time": "1 ms"},
        "grip": {"slip": "0.1 mm", "normal_force": "50 mN", "opening": "0.1 mm"},
    }[primitive]
    tolerance = {name: text.replace(" mN", "e-3 N") for name, text in tolerance.items()}
    return {
        "target": {"primitive": primitive, "pair": pair, **target},
        "stimulus": stimulus,
        "tolerance": tolerance,
    }


APPROACH = spec(
    "approach", ["object", "table"], {"duration": "1 s", "gap": "1 mm", "press": "3 N"}, object=BOX
)
PUSH = {"direction": [1, 0.5, 0], "force": "6 N", "duration": "0.5 s"}
SLIDE = spec(
    "slide", ["object", "table"], {"duration": "0.5 s", "gap": "1 mm", "slide": PUSH}, object=BOX
)
RELEASE = spec("release", ["object", "table"], {"duration": "0.6 s", "gap": "50 mm"}, object=BALL)
GRIP = spec(
    "grip",
    ["left", "right"],
    {"duration": "0.5 s", "hold": "0.5 s", "command": {"l": 0.05, "r": 0.05}},
    object={"shape": "box", "size": [0.01, 0.02, 0.01], "mass": "0.1 kg", "frame": "grasp"},
)


def test_normal_force_at_rest_equals_weight_plus_pressing_force(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    found = observe(CHECK, golden_of(CHECK, APPROACH), robot).values
    assert found["normal_force"] == pytest.approx(MASS * GRAVITY + 3.0, rel=1e-4)
    assert found["onset"][2] == pytest.approx(0.02, abs=2e-4)
    assert found["onset"][3:] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)


def test_onset_time_of_a_falling_object_equals_the_closed_form(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell(timestep=0.0005))
    found = observe(CHECK, golden_of(CHECK, RELEASE), robot).values
    assert found["onset_time"] == pytest.approx(np.sqrt(2.0 * 0.05 / GRAVITY), abs=0.001)


@pytest.mark.parametrize("damping", [10.0, 40.0, 100.0])
def test_rebound_of_a_damped_contact_equals_the_damped_spring(
    tmp_path: Path, damping: float
) -> None:
    """A hard contact with negative solref has the acceleration of a damped spring."""
    table = HARD.replace(f"{DAMPED:g}", f"{damping:g}")
    robot = load_text(tmp_path, workcell(table=table, timestep=0.0002))
    found = observe(CHECK, golden_of(CHECK, RELEASE), robot).values

    def rate(_: float, state: np.ndarray) -> list[float]:
        depth, speed = state
        return [speed, min(GRAVITY, -STIFF * depth - damping * speed)]  # a contact cannot pull

    def separation(_: float, state: np.ndarray) -> float:
        return float(state[0])

    separation.direction, separation.terminal = -1.0, True  # type: ignore[attr-defined]
    impact = np.sqrt(2.0 * GRAVITY * 0.05)
    bounce = solve_ivp(rate, (0.0, 0.2), [1e-12, impact], events=separation, rtol=1e-9, atol=1e-12)
    restitution = -bounce.y[1, -1] / impact
    assert found["restitution"] == pytest.approx(restitution, abs=0.01)
    assert found["rebound"] == pytest.approx(restitution**2 * 0.05, abs=1e-3)


def test_penetration_at_rest_follows_from_the_contact_stiffness(tmp_path: Path) -> None:
    impedance = 0.9
    table = f'solref="-{STIFF:g} -200" solimp="{impedance} {impedance} 0.001 0.5 2"'
    robot = load_text(tmp_path, workcell(table=table))
    one_point = {**APPROACH, "target": {**APPROACH["target"], "object": BALL}}
    found = observe(CHECK, golden_of(CHECK, one_point), robot).values
    # With impedance d the constraint provides the share d of the acceleration; stiffness is k / d.
    load = GRAVITY + 3.0 / MASS
    assert found["penetration"] == pytest.approx((1.0 - impedance) * load / STIFF, rel=1e-3)


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_slip_starts_at_the_coulomb_friction_force(tmp_path: Path, friction: float) -> None:
    robot = load_text(tmp_path, workcell(table=f'friction="{friction} 0.005 0.0001"'))
    observation = observe(CHECK, golden_of(CHECK, SLIDE), robot)
    found = observation.values
    assert found["declared_friction"] == pytest.approx(friction)
    assert found["friction"] == pytest.approx(friction, rel=2e-3)
    assert found["slip_force"] == pytest.approx(friction * MASS * GRAVITY, rel=0.02)
    assert observation.trace is not None
    travel = observation.trace.columns["travel"][1][-1]
    # After slip onset the increasing force minus dry friction accelerates the box.
    onset = friction * MASS * GRAVITY / 6.0 * 0.5
    exact = 6.0 / 0.5 / (6.0 * MASS) * (0.5 - onset) ** 3
    assert travel == pytest.approx(exact, rel=0.05)


def test_the_declared_friction_of_the_object_is_used(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    rough = {**SLIDE, "target": {**SLIDE["target"], "object": {**BOX, "friction": 0.9}}}
    found = observe(CHECK, golden_of(CHECK, rough), robot).values
    assert found["friction"] == pytest.approx(0.9, rel=2e-3)  # MuJoCo takes the greater


def test_a_pair_that_no_longer_slips_fails_its_friction_measures(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    golden, trace = recorded(CHECK, SLIDE, robot)
    held = load_text(tmp_path, workcell(table='friction="4 0.005 0.0001"'), "held.xml")
    measures = measures_on(CHECK, golden, trace, held)
    assert measures["friction"].subject == ("object on table: undefined now (the pair never slips)")
    assert {"friction", "slip_force", "declared_friction"} <= failed(measures)


def test_a_robot_tip_pressed_on_the_table_has_the_servo_force(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    touch = spec(
        "approach",
        ["tip", "table"],
        {"duration": "2 s", "ramp": "1 s", "command": {"down": 0.11}},
    )
    found = observe(CHECK, golden_of(CHECK, touch), robot).values
    # Servo force from its position error plus weight equals the normal force.
    expected = 500.0 * (0.11 - 0.1 - found["penetration"]) + 0.3 * GRAVITY
    assert found["normal_force"] == pytest.approx(expected, rel=1e-3)
    assert found["onset"][2] == pytest.approx(0.02, abs=1e-3)
    assert found["onset"][0] == pytest.approx(-0.5, abs=1e-6)


def test_a_robot_tip_under_load_slips_at_the_friction_force(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    slide = spec(
        "slide",
        ["tip", "table"],
        {
            "duration": "1.5 s",
            "ramp": "1 s",
            "command": {"down": 0.11},
            "slide": {"direction": [1, 0, 0], "force": "10 N", "duration": "0.5 s"},
        },
    )
    found = observe(CHECK, golden_of(CHECK, slide), robot).values
    assert found["friction"] == pytest.approx(0.6, rel=0.01)
    assert found["slip_force"] == pytest.approx(0.6 * found["normal_force"], rel=0.02)


def test_an_effort_presses_a_joint_without_servo_on_the_table(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell().replace('<position name="down"', '<motor name="down"')
                      .replace('joint="down" kp="500" kv="20"', 'joint="down"'))  # fmt: skip
    touch = spec("approach", ["stem", "table"], {"duration": "2 s", "effort": {"down": "2 N"}})
    found = observe(CHECK, golden_of(CHECK, touch), robot).values
    assert found["normal_force"] == pytest.approx(2.0 + 0.3 * GRAVITY, rel=1e-3)


def test_a_gripper_holds_an_object_only_if_friction_exceeds_its_weight(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    found = observe(CHECK, golden_of(CHECK, GRIP), robot).values
    assert found["normal_force"] == pytest.approx(10.0, rel=0.02)  # the servos' force range
    assert found["opening"] == pytest.approx(0.04, abs=2e-3)
    assert found["slip"] < 2e-3
    weak = load_text(tmp_path, workcell(force=0.3), "weak.xml")
    dropped = observe(CHECK, golden_of(CHECK, GRIP), weak).values
    assert dropped["slip"] is None  # 2 * 0.8 * 0.3 N is less than its weight of 0.98 N


@pytest.mark.parametrize(
    ("golden_spec", "change", "caught"),
    [
        (APPROACH, {}, set()),
        (APPROACH, {"table": 'solref="0.03 1"'}, {"penetration"}),
        (APPROACH, {"timestep": 0.004}, {"onset_time", "position"}),
        (SLIDE, {}, set()),
        (SLIDE, {"table": 'friction="0.5 0.005 0.0001"'}, {"friction", "slip_force"}),
        (RELEASE, {}, set()),
        (RELEASE, {"table": HARD.replace("40", "48")}, {"rebound", "restitution"}),
        (GRIP, {}, set()),
        (GRIP, {"force": 8.0}, {"normal_force"}),
        (GRIP, {"pads": 'friction="0.04 0.005 0.0001"'}, {"slip"}),
    ],
)
def test_changed_contact_parameters_fail_the_expected_measures(
    tmp_path: Path, golden_spec: dict[str, Any], change: dict[str, Any], caught: set[str]
) -> None:
    plain: dict[str, Any] = {"table": HARD} if golden_spec is RELEASE else {}
    golden, trace = recorded(CHECK, golden_spec, load_text(tmp_path, workcell(**plain)))
    changed = load_text(tmp_path, workcell(**plain | change), "changed.xml")
    found = failed(measures_on(CHECK, golden, trace, changed))
    assert caught <= found
    assert bool(found) == bool(change)


def test_a_contact_that_does_not_show_its_declared_friction_fails(tmp_path: Path) -> None:
    # A pyramidal friction cone resists more along the diagonal than the declared coefficient.
    robot = load_text(tmp_path, workcell().replace('cone="elliptic"', 'cone="pyramidal"'))
    diagonal = {**PUSH, "direction": [1, 1, 0]}
    golden, trace = recorded(
        CHECK, {**SLIDE, "stimulus": {**SLIDE["stimulus"], "slide": diagonal}}, robot
    )
    measure = measures_on(CHECK, golden, trace, robot)["declared_friction"]
    assert measure.against == "declared"
    assert not measure.passed


def test_a_floating_base_robot_is_released_onto_an_added_floor(tmp_path: Path) -> None:
    text = """
    <mujoco><option timestep="0.001"/><worldbody>
      <body name="base" pos="0 0 3"><freejoint name="root"/><geom size=".1" mass="4"/>
        <body name="leg" pos="0 0 -.1"><geom name="foot" type="box" pos="0 0 -.2" size=".1 .1 .02"
          mass="1"/></body></body></worldbody></mujoco>"""
    robot = load_text(tmp_path, text)
    landing = spec("release", ["foot", "floor"], {"duration": "1 s", "gap": "20 mm"}, floor="-1 m")
    found = observe(CHECK, golden_of(CHECK, landing), robot).values
    assert found["onset_time"] == pytest.approx(np.sqrt(2.0 * 0.02 / GRAVITY), abs=0.002)
    assert found["normal_force"] == pytest.approx(5.0 * GRAVITY, rel=1e-3)
    assert [spec["name"] for spec in CHECK.first(robot)] == ["release_leg", "slide_over_foot"]


@pytest.mark.parametrize(
    ("golden_spec", "words"),
    [
        (spec("approach", ["tipp", "table"], {"duration": "1 s"}), "did you mean 'tip'?"),
        (
            spec("approach", ["object", "table"], {"duration": "1 s"}),
            "no geom or body that collides",
        ),
        (spec("slide", ["tip", "table"], {"duration": "1 s"}), "stimulus.slide: a slide needs it"),
        (spec("grip", ["left", "right"], {"duration": "1 s", "hold": "1 s"}), "a grip needs one"),
        (spec("release", ["tip", "table"], {"duration": "1 s"}), "cannot be let go"),
        (spec("approach", ["tip", "table"], {"duration": "1 s"}), "the pair never touched"),
        (
            spec("approach", ["tip", "table"], {"duration": "1 s", "command": {"downn": 1.0}}),
            "did you mean 'down'?",
        ),
        (
            spec("approach", ["tip", "table"], {"duration": "1 s", "effort": {"down": "1 N*m"}}),
            "unit 'N*m' does not fit",
        ),
        (
            spec("approach", ["object", "table"], {"duration": "1 s"}, object={**BOX, "size": [1]}),
            "not the size of a box",
        ),
        (
            spec("approach", ["object", "table"], {"duration": "1 s"}, object={**BOX, "mass": 0}),
            "no mass",
        ),
        (
            {**SLIDE, "stimulus": {**SLIDE["stimulus"], "slide": {**PUSH, "direction": [0, 0, 1]}}},
            "has no part along the surface",
        ),
        (spec("approach", ["tip", "table"], {"duration": "0 s"}), "out of bounds"),
        (
            {
                **GRIP,
                "target": {
                    **GRIP["target"],
                    "object": {**GRIP["target"]["object"], "size": [0.01, 0.2, 0.01]},
                },
            },
            "starts inside 'left_pad'",
        ),
    ],
)
def test_invalid_contact_specs_are_refused_with_their_line(
    tmp_path: Path, golden_spec: dict[str, Any], words: str
) -> None:
    robot = load_text(tmp_path, workcell())
    with pytest.raises(SpecError) as caught:
        observe(CHECK, golden_of(CHECK, golden_spec), robot)
    assert words in str(caught.value)
    assert caught.value.line is not None


def test_the_contact_check_does_not_modify_the_model(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    before = robot.spec.to_xml()
    observe(CHECK, golden_of(CHECK, APPROACH), robot)
    assert robot.spec.to_xml() == before
    assert robot.model.nbody == load_text(tmp_path, workcell()).model.nbody


@pytest.mark.parametrize("golden_spec", [APPROACH, SLIDE, RELEASE, GRIP])
def test_repeated_runs_of_a_contact_golden_are_identical(
    tmp_path: Path, golden_spec: dict[str, Any]
) -> None:
    robot = load_text(tmp_path, workcell())
    first, second = (observe(CHECK, golden_of(CHECK, golden_spec), robot) for _ in range(2))
    assert first.values == second.values
    assert first.trace is not None
    assert second.trace is not None
    for name, (_, series) in first.trace.columns.items():
        np.testing.assert_array_equal(series, second.trace.columns[name][1])


def test_proposed_contact_goldens_use_a_static_surface_and_pass(tmp_path: Path) -> None:
    robot = load_text(tmp_path, workcell())
    specs = CHECK.first(robot)
    assert [spec["name"] for spec in specs] == [
        *("release_table", "slide_table", "slide_over_right_pad", "slide_over_tip"),
    ]
    for first in specs[:2]:
        golden, trace = recorded(CHECK, first, robot)
        measures = measures_on(CHECK, golden, trace, robot)
        assert "normal_force" in measures
        assert failed(measures) == set()


def test_the_schema_and_the_scene_support_the_same_shapes() -> None:
    assert set(SIZES) == set(scene.SHAPES)


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("box", (0.01, 0.02, 0.03)),
        ("sphere", (0.02,)),
        ("cylinder", (0.01, 0.03)),
        ("capsule", (0.01, 0.03)),
    ],
)
def test_moments_of_inertia_of_added_objects_equal_mujocos(
    shape: str, size: tuple[float, ...]
) -> None:
    numbers = " ".join(map(str, size))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><freejoint/>
        <geom type="{shape}" size="{numbers}" mass="0.3"/></body></worldbody></mujoco>"""
    )
    found = scene.moments(scene.FreeObject(shape, size, 0.3))
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[1])
    axes = rotation.reshape(3, 3)
    expected = axes @ np.diag(model.body_inertia[1]) @ axes.T
    np.testing.assert_allclose(np.diag(found), expected, atol=1e-12)


def test_added_objects_ignore_the_default_classes_of_the_model(tmp_path: Path) -> None:
    plain = observe(CHECK, golden_of(CHECK, SLIDE), load_text(tmp_path, workcell())).values
    text = workcell().replace(
        "<worldbody>",
        """<default><geom margin="0.01" solref="0.1 2" contype="0" friction="3 1 1"
        priority="2" condim="1"/></default><worldbody>""",
        1,
    ).replace('name="table"', 'name="table" contype="1" priority="0" margin="0" condim="3" '
              'solref="0.02 1"')  # fmt: skip
    text = text.replace(
        '"/>\n        <body name="probe"', '" gap="0"/>\n        <body name="probe"'
    )
    changed = observe(
        CHECK, golden_of(CHECK, SLIDE), load_text(tmp_path, text, "defaults.xml")
    ).values
    assert changed["friction"] == pytest.approx(plain["friction"], rel=1e-6)
    assert changed["penetration"] == pytest.approx(plain["penetration"], rel=1e-6)


def test_an_added_object_has_its_mass_if_the_model_ignores_geom_inertia(tmp_path: Path) -> None:
    text = workcell().replace(
        '<compiler angle="radian"/>', '<compiler angle="radian" inertiafromgeom="false"/>'
    )
    inertial = '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/>'
    for joint in ("along", "down", "l", "r"):
        text = text.replace(f'<joint name="{joint}"', f'{inertial}<joint name="{joint}"')
    found = observe(CHECK, golden_of(CHECK, APPROACH), load_text(tmp_path, text)).values
    assert found["normal_force"] == pytest.approx(MASS * GRAVITY + 3.0, rel=1e-4)


ARM_ALONE = """
    <mujoco><worldbody>
      <body name="link"><joint axis="0 1 0" damping="1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0"/></body></worldbody></mujoco>"""


def test_for_an_arm_alone_a_ball_pushed_over_its_link_is_proposed(tmp_path: Path) -> None:
    robot = load_text(tmp_path, ARM_ALONE)
    (first,) = CHECK.first(robot)
    assert first["name"] == "slide_over_link"
    golden, trace = recorded(CHECK, first, robot)
    measures = measures_on(CHECK, golden, trace, robot)
    assert set(measures) == {"onset_time", "position", "penetration", "friction"}
    assert failed(measures) == set()


def test_a_ball_that_does_not_slip_is_only_pressed_on_the_link(tmp_path: Path) -> None:
    sticky = ARM_ALONE.replace("<geom", '<geom friction="9"')
    assert [s["name"] for s in CHECK.first(load_text(tmp_path, sticky))] == ["approach_link"]


FEET = """
    <mujoco><worldbody>{floor}<body name="trunk" pos="0 0 .3"><freejoint/>
      <geom type="box" size=".2 .1 .05" friction=".8"/>
      <body name="leg"><joint name="hip" axis="0 1 0"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2" friction=".8"/>
        <geom name="{foot}" size=".03" pos="0 0 -.22" friction="{friction}"/>
      </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("floor", ["", '<geom name="ground" type="plane" size="0 0 1"/>'])
@pytest.mark.parametrize("foot", ["foot", ""])
def test_a_proposed_golden_shows_the_friction_of_a_foot(
    floor: str, foot: str, tmp_path: Path
) -> None:
    """Both frictions are below that of the floor, which MuJoCo then takes for foot and floor."""
    walker = load_text(tmp_path, FEET.format(floor=floor, foot=foot, friction=0.6))
    changed = load_text(tmp_path, FEET.format(floor=floor, foot=foot, friction=0.9))
    fails = []
    for first in CHECK.first(walker):
        golden, trace = recorded(CHECK, first, walker)
        assert failed(measures_on(CHECK, golden, trace, walker)) == set()
        if failed(measures_on(CHECK, golden, trace, changed)):
            fails.append(first["name"])
    assert fails == ["slide_over_foot" if foot else "slide_over_leg_1"]


def test_contact_force_and_normal_act_on_the_first_body_of_the_pair(tmp_path: Path) -> None:
    robot = load_text(
        tmp_path,
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body pos="0 0 .049"><freejoint/><geom name="ball" size=".05" mass="1"/></body>
        </worldbody></mujoco>""",
    )
    data = mujoco.MjData(robot.model)
    mujoco.mj_forward(robot.model, data)
    ball, floor = (scene.geoms_of(robot.model, name, False) for name in ("ball", "floor"))
    upper = scene.pair_contact(robot.model, data, ball, floor)
    lower = scene.pair_contact(robot.model, data, floor, ball)
    assert upper.normal == pytest.approx([0.0, 0.0, 1.0])
    assert upper.force[2] > 0.0
    assert upper.normal_force == pytest.approx(upper.force[2])
    assert upper.depth == pytest.approx(1e-3)
    assert lower.normal == pytest.approx(-upper.normal)
    assert lower.force == pytest.approx(-upper.force)
    assert lower.normal_force == pytest.approx(upper.normal_force)
