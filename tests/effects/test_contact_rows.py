"""Contact effects in batch rows equal the same change made by hand in a separate MuJoCo model."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.contact_geoms import find_contact_geoms, scaled_solref
from pytest_twin.effects.segment import Segment

ARM = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
{world}
<body pos="0 0 .3"><joint name="a" axis="0 1 0" damping=".2"/>
<geom name="upper" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" {robot}/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0" damping=".1"/>
<geom name="tip" type="capsule" fromto="0 0 0 .25 0 0" size=".02" mass=".5" {robot}/></body></body>
</worldbody><actuator><position joint="a" kp="20" kv="1"/><position joint="b" kp="10" kv=".5"/>
</actuator>{more}</mujoco>
"""
JOINTS = ("a", "b")
PLANE = '<geom name="floor" type="plane" size="1 1 .1" {}/>'
TABLE = '<geom name="floor" type="box" size=".3 .3 .05" pos=".4 0 -.05" {}/>' + "".join(
    f'<geom type="box" size=".05 .05 .05" pos="{2 + k} 0 0"/>' for k in range(6)
)
TURNED = """<body name="stand" euler="0 90 0">
<geom name="floor" type="box" size=".05 .3 .3" pos=".05 0 .4" {}/></body>"""
PAIR = """<contact>
<pair geom1="floor" geom2="tip" solref="{} {}" friction="{} {} .005 .0001 .0001"/></contact>"""


def build(world: str = PLANE, floor: str = "", robot: str = "", more: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        ARM.format(world=world.format(floor), robot=robot, more=more)
    )


def segment(model: mujoco.MjModel, measured: np.ndarray | None = None) -> Segment:
    t = 0.01 * np.arange(150)
    command = np.column_stack([0.55 + 0.3 * np.sin(5 * t), 0.3 + 0.3 * np.sin(3 * t)])
    still = np.zeros(2)
    return Segment(
        trial=0, model=model, mode="position", start=0.0, time=t,
        position=command if measured is None else measured, velocity=None, effort=None,
        command_time=t, command=command, initial_position=still, initial_velocity=still,
    )  # fmt: skip


def simulate_in_mujoco(model: mujoco.MjModel) -> np.ndarray:
    """Joint positions (rad) at the segment's stamps from MuJoCo stepping the model by itself."""
    s = segment(model)
    data = mujoco.MjData(model)
    data.qpos[:] = s.initial_position
    out = np.empty_like(s.position)
    for k in range(len(s.time)):
        out[k] = data.qpos
        data.ctrl[:] = s.command[k]
        mujoco.mj_step(model, data, 5)
    return out


def largest_difference(
    model: mujoco.MjModel, effects: dict[str, dict[str, float]], by_hand: mujoco.MjModel
) -> float:
    """Largest difference, rad, between a row with effects and a model changed by hand."""
    # The first row has no effect: rows of one batch must not influence each other.
    values = {
        e: {n: np.array([[0.0, 0.0], [x, x]]) for n, x in parameters.items()}
        for e, parameters in effects.items()
    }
    measured = simulate_in_mujoco(by_hand)
    simulator = BatchSimulator([segment(model, measured)], JOINTS, threads=1)
    nominal, changed = simulator.simulate(np.zeros(2, dtype=np.int64), values)
    assert np.abs(nominal.position - simulate_in_mujoco(model)).max() < 1e-9
    assert np.abs(changed.position - nominal.position).max() > 1e-3, (
        "the effect does not change the motion"
    )
    return float(np.abs(changed.position - measured).max())


S, D, MU, OFFSET = 0.7, -0.4, -0.6, 0.025
STANDARD = 'solref="{:.17g} {:.17g}"'
MIXED = ('solref=".03 .9" solmix="3" friction=".7"', 'solref=".01 1.2" friction=".9"')


@pytest.mark.parametrize(
    "world", [PLANE, TABLE, TURNED], ids=["plane", "box among others", "rotated body"]
)
@pytest.mark.parametrize("offset", [OFFSET, -OFFSET])
def test_contact_offset_moves_the_surface_along_its_normal(world: str, offset: float) -> None:
    made = mujoco.MjSpec.from_string(ARM.format(world=world.format(""), robot="", more=""))
    floor = made.geom("floor")
    floor.pos = floor.pos + ([-offset, 0, 0] if world is TURNED else [0, 0, offset])
    assert (
        largest_difference(build(world), {"contact_offset": {"offset": offset}}, made.compile())
        < 1e-9
    )


@pytest.mark.parametrize(
    ("effects", "nominal", "changed"),
    [
        (
            {"contact_stiffness": {"relative_error": S}},
            ("", ""),
            (STANDARD.format(0.02, (1 + S) ** -0.5),) * 2,
        ),
        (
            {"contact_damping": {"relative_error": D}},
            ("", ""),
            (STANDARD.format(0.02 / (1 + D), 1 + D),) * 2,
        ),
        (
            {"contact_stiffness": {"relative_error": S}, "contact_damping": {"relative_error": D}},
            ('solref="-2000 -90"', ""),
            (STANDARD.format(-2000 * (1 + S), -90 * (1 + D)), ""),
        ),
        (
            {"contact_friction": {"coefficient": MU}},
            ('friction=".7"', 'friction=".9"'),
            ('friction=".3"', 'friction=".1"'),
        ),
        (
            {"contact_stiffness": {"relative_error": S}},
            MIXED,
            (
                MIXED[0].replace(".03 .9", f".03 {0.9 * (1 + S) ** -0.5:.17g}"),
                MIXED[1].replace(".01 1.2", f".01 {1.2 * (1 + S) ** -0.5:.17g}"),
            ),
        ),
        (
            {"contact_damping": {"relative_error": D}},
            ('priority="1" solref=".05 1"', ""),
            (f'priority="1" solref="{0.05 / (1 + D):.17g} {1 + D:.17g}"', ""),
        ),
    ],
    ids=["stiffness", "damping", "direct form", "friction", "mixed", "priority"],
)  # fmt: skip
def test_contact_effect_equals_the_same_change_in_mjcf(
    effects: dict[str, dict[str, float]], nominal: tuple[str, str], changed: tuple[str, str]
) -> None:
    before, after = (build(floor=floor, robot=robot) for floor, robot in (nominal, changed))
    assert largest_difference(before, effects, after) < 1e-9


def test_contact_friction_is_never_negative() -> None:
    smooth = build(floor='friction="0"', robot='friction="0"')
    measured = simulate_in_mujoco(smooth)
    found = [
        BatchSimulator([segment(model, measured)], JOINTS, threads=1)
        .simulate(np.zeros(1, dtype=np.int64), effects)[0]
        .position
        for model, effects in (
            (build(), {"contact_friction": {"coefficient": np.full((1, 2), -3.0)}}),
            (smooth, {}),
        )
    ]
    assert np.abs(found[0] - found[1]).max() < 1e-9


def test_contact_effects_apply_to_explicit_contact_pairs() -> None:
    effects = {
        "contact_stiffness": {"relative_error": S},
        "contact_damping": {"relative_error": D},
        "contact_friction": {"coefficient": -0.3},
    }
    by_hand = PAIR.format(
        f"{0.03 / (1 + D):.17g}", f"{0.9 * (1 + D) * (1 + S) ** -0.5:.17g}", 0.5, 0.3
    )
    before = build(more=PAIR.format(0.03, 0.9, 0.8, 0.6))
    assert largest_difference(before, effects, build(more=by_hand)) < 1e-9


@pytest.mark.parametrize("solref", [(0.02, 1.0), (0.05, 0.3), (0.001, 1.0), (-3000.0, -80.0)])
def test_scaled_solref_scales_stiffness_and_damping_in_both_mujoco_forms(
    solref: tuple[float, float],
) -> None:
    """MuJoCo's reference acceleration of a contact is -b v - k r; k and b are scaled."""

    def constants(ref: np.ndarray) -> tuple[float, float]:
        model = build(floor=f'priority="1" solref="{ref[0]:.17g} {ref[1]:.17g}" condim="1"')
        data = mujoco.MjData(model)
        data.qpos[:] = (1.2, 0.4)
        mujoco.mj_forward(model, data)
        rest = data.efc_aref[0]
        stiffness = -rest / data.efc_pos[0]
        data.qvel[:] = (0.3, 0.1)
        mujoco.mj_forward(model, data)
        return stiffness, -(data.efc_aref[0] - rest) / data.efc_vel[0]

    before = constants(np.array(solref))
    for e, c in ((0.5, 0.0), (0.0, -0.3), (2.0, -0.6)):
        scaled = scaled_solref(np.array(solref), np.array(1 + e), np.array(1 + c), 0.004)
        after = constants(scaled)
        assert after == pytest.approx((before[0] * (1 + e), before[1] * (1 + c)), rel=1e-9)


def test_damping_limited_by_mujoco_leaves_the_contact_stiffness_unchanged() -> None:
    scaled = scaled_solref(np.array((0.005, 1.0)), np.array(1.0), np.array(4.0), 0.004)
    assert scaled == pytest.approx((0.004, 1.25))
    assert scaled_solref(np.array((0.001, 1.0)), np.array(1.0), np.array(4.0), 0.004) == (
        pytest.approx((0.001, 1.0))
    )


def contact_geom_names(model: mujoco.MjModel, poses: np.ndarray) -> list[str]:
    ids = np.array([model.joint(j).id for j in JOINTS])
    found = find_contact_geoms(model, ids, [poses])
    return [model.geom(g).name for g in (*found.world, *found.robot)]


def test_contact_geoms_are_only_those_that_come_within_5_cm() -> None:
    """The tip is 25 cm below the floor at 1.0 rad and 8 cm above it at 0.4 rad."""
    assert contact_geom_names(build(), np.array([[0.4, 0.0]])) == []
    assert contact_geom_names(build(), np.array([[0.4, 0.0], [0.5, 0.0]])) == ["floor", "tip"]
    assert (
        contact_geom_names(build(floor='contype="0" conaffinity="0"'), np.array([[1.0, 0.0]])) == []
    )
    assert contact_geom_names(build(world=""), np.array([[1.0, 0.0]])) == []
    for floor, robot, expected in (
        ('contype="0" conaffinity="4"', 'contype="4" conaffinity="0"', ["floor", "tip"]),
        ('contype="4" conaffinity="0"', 'contype="0" conaffinity="4"', ["floor", "tip"]),
        ('contype="4" conaffinity="1"', 'contype="8" conaffinity="2"', []),
        ('contype="65536" conaffinity="0"', 'contype="0" conaffinity="65536"', ["floor", "tip"]),
    ):
        assert (
            contact_geom_names(build(floor=floor, robot=robot), np.array([[0.5, 0.0]])) == expected
        )


def test_the_robot_base_is_not_a_contact_surface() -> None:
    """A URDF reader may fuse the base into the world body."""
    fused = PLANE + '<geom name="base" type="sphere" size=".03" pos="0 0 .3"/>'
    poses = np.column_stack([np.linspace(0.0, 0.7, 20), np.zeros(20)])
    assert contact_geom_names(build(world=fused), poses) == ["floor", "tip"]
