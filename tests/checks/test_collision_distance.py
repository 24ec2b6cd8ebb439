from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from check_robots import ARM, failed, from_first, golden, measure, record, robot
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pytest_twin.checks.collision_distance import CollisionDistance
from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import collision

CHECK = CollisionDistance()
SHAPES = {
    "sphere": 'type="sphere" size="0.1"',
    "capsule": 'type="capsule" size="0.05 0.1"',
    "cylinder": 'type="cylinder" size="0.08 0.1"',
    "box": 'type="box" size="0.1 0.05 0.2"',
    "ellipsoid": 'type="ellipsoid" size="0.1 0.05 0.2"',
    "mesh": 'type="mesh" mesh="wedge"',
}
WEDGE = "0 0 0  0.2 0 0  0 0.3 0  0.2 0.3 0  0 0 0.1  0 0.3 0.15"


def two_free_bodies(folder: Path, first: str, second: str, extra: str = "") -> tuple:
    """A realization with two free bodies ``a`` and ``b``, and its shapes."""
    realization = robot(
        folder,
        f"""<mujoco><asset><mesh name="wedge" vertex="{WEDGE}"/></asset><worldbody>
        <body name="a"><freejoint/><geom name="a" {first} {extra}/></body>
        <body name="b"><freejoint/><geom name="b" {second} {extra}/></body>
        </worldbody></mujoco>""",
    )
    return realization, collision.Shapes(realization)


def both_distances(
    realization: object, shapes: collision.Shapes, place: list[float]
) -> tuple[float, float]:
    """Distances (m) by MuJoCo and coal with body b at the pose ``place`` (xyz, qw, qx, qy, qz)."""
    data = mujoco.MjData(realization.model)
    data.qpos[7:] = place
    mujoco.mj_kinematics(realization.model, data)
    a, b = shapes.geoms("a"), shapes.geoms("b")
    return shapes.distance(data, a, b), shapes.distance_by_coal(data, a, b)


half = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("first", "second", "place", "expected"),
    [
        ("sphere", "sphere", [0.3, 0.4, 0, 1, 0, 0, 0], 0.3),
        ("sphere", "sphere", [0.15, 0, 0, 1, 0, 0, 0], -0.05),
        ("sphere", "box", [0, 0, 0.5, 1, 0, 0, 0], 0.2),
        ("sphere", "box", [0.15, 0, 0, 1, 0, 0, 0], -0.05),
        ("capsule", "capsule", [0.3, 0, 0.1, 1, 0, 0, 0], 0.2),
        ("capsule", "capsule", [0, 0.25, 0, half, 0, half, 0], 0.15),
        ("capsule", "sphere", [0, 0, 0.5, 1, 0, 0, 0], 0.25),
        ("box", "box", [0.3, 0, 0, 1, 0, 0, 0], 0.1),
        ("box", "box", [0.3, 0.4, 0, 1, 0, 0, 0], np.hypot(0.1, 0.3)),
        ("box", "box", [0.19, 0, 0, 1, 0, 0, 0], -0.01),
        ("sphere", "cylinder", [0.3, 0, 0, 1, 0, 0, 0], 0.12),
        ("sphere", "cylinder", [0.1, 0, 0, 1, 0, 0, 0], -0.08),
        ("ellipsoid", "sphere", [0, 0, 0.4, 1, 0, 0, 0], 0.1),
    ],
)
@pytest.mark.parametrize("extra", ["", 'margin="0.05" gap="0.02"'])
def test_distances_of_primitive_shapes_equal_closed_forms(
    tmp_path: Path, first: str, second: str, place: list[float], expected: float, extra: str
) -> None:
    realization, shapes = two_free_bodies(tmp_path, SHAPES[first], SHAPES[second], extra)
    by_mujoco, by_coal = both_distances(realization, shapes, place)
    assert by_mujoco == pytest.approx(expected, abs=1e-6)
    assert by_coal == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("shape", "rotation", "reach"),
    [
        ("sphere", [1, 0, 0, 0], 0.1),
        ("box", [1, 0, 0, 0], 0.2),
        ("box", [half, 0, half, 0], 0.1),
        ("capsule", [half, 0, half, 0], 0.05),
        ("cylinder", [1, 0, 0, 0], 0.1),
        ("ellipsoid", [half, half, 0, 0], 0.05),
    ],
)
@pytest.mark.parametrize("height", [0.5, 0.05])
def test_distance_to_a_plane_treats_it_as_a_half_space(
    tmp_path: Path, shape: str, rotation: list[float], reach: float, height: float
) -> None:
    realization = robot(
        tmp_path,
        f"""<mujoco><worldbody><geom name="a" type="plane" size="1 1 0.1"/>
        <body name="b"><freejoint/><geom name="b" {SHAPES[shape]}/></body></worldbody></mujoco>""",
    )
    shapes = collision.Shapes(realization)
    data = mujoco.MjData(realization.model)
    data.qpos[:] = [0.3, 0.2, height, *rotation]
    mujoco.mj_kinematics(realization.model, data)
    a, b = shapes.geoms("a"), shapes.geoms("b")
    assert shapes.distance(data, a, b) == pytest.approx(height - reach, abs=1e-6)
    assert shapes.distance_by_coal(data, a, b) == pytest.approx(height - reach, abs=1e-6)


places = st.tuples(*[st.floats(-0.5, 0.5)] * 3, *[st.floats(-1, 1)] * 4).filter(
    lambda p: np.linalg.norm(p[3:]) > 0.1
)


@pytest.mark.parametrize("first", SHAPES)
@pytest.mark.parametrize("second", SHAPES)
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(place=places)
def test_mujoco_and_coal_agree_on_the_distance_of_separated_shapes(
    tmp_path: Path, first: str, second: str, place: tuple
) -> None:
    realization, shapes = two_free_bodies(tmp_path, SHAPES[first], SHAPES[second])
    by_mujoco, by_coal = both_distances(realization, shapes, list(place))
    if by_coal > 1e-4:
        assert by_mujoco == pytest.approx(by_coal, abs=1e-6)
    else:
        assert by_mujoco <= 1e-3


def support(model: mujoco.MjModel, data: mujoco.MjData, geom: int, ways: np.ndarray) -> np.ndarray:
    """(n,) support function of a geom along each direction of ``ways`` (n, 3), m."""
    x, y, z = np.abs(ways @ data.geom_xmat[geom].reshape(3, 3)).T
    a, b, c = model.geom_size[geom]
    reach = {
        mujoco.mjtGeom.mjGEOM_BOX: a * x + b * y + c * z,
        mujoco.mjtGeom.mjGEOM_CYLINDER: a * np.hypot(x, y) + b * z,
        mujoco.mjtGeom.mjGEOM_SPHERE: a + 0 * x,
    }
    return ways @ data.geom_xpos[geom] + reach[mujoco.mjtGeom(model.geom_type[geom])]


@pytest.mark.parametrize(
    ("first", "second", "offset"),
    [
        ("sphere", "cylinder", [0.06, 0.02, 0.09]),
        ("box", "cylinder", [0.1, 0.05, 0.1]),
        ("box", "box", [0.1, 0.03, 0.2]),
    ],
)
def test_penetration_depth_is_the_shortest_separating_translation(
    tmp_path: Path, first: str, second: str, offset: list[float]
) -> None:
    realization, shapes = two_free_bodies(tmp_path, SHAPES[first], SHAPES[second])
    place = [*offset, 1, 0, 0, 0]
    data = mujoco.MjData(realization.model)
    data.qpos[7:] = place
    mujoco.mj_kinematics(realization.model, data)
    azimuth, height = np.meshgrid(np.linspace(0, 2 * np.pi, 721), np.linspace(-1, 1, 801))
    ring = np.sqrt(1 - height**2)
    ways = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], -1).reshape(-1, 3)
    model = realization.model
    depth = np.min(support(model, data, 0, ways) + support(model, data, 1, -ways))
    by_mujoco, by_coal = both_distances(realization, shapes, place)
    assert by_mujoco == pytest.approx(-depth, abs=2e-4)
    assert by_coal == pytest.approx(-depth, abs=2e-4)


def test_mujoco_underestimates_the_penetration_of_a_capsule_in_a_box(tmp_path: Path) -> None:
    """A known limit of MuJoCo's capsule-box routine, covered by the tolerance ``penetration``."""
    realization, shapes = two_free_bodies(tmp_path, SHAPES["capsule"], SHAPES["box"])
    by_mujoco, by_coal = both_distances(realization, shapes, [0, 0, 0, half, 0, half, 0])
    # The box is rotated so that its long side lies along x: half its thin side plus the radius.
    assert by_coal == pytest.approx(-(0.05 + 0.05), abs=1e-6)
    assert by_coal + 1e-3 < by_mujoco < 0.0


def test_distance_to_a_mesh_uses_its_convex_hull(tmp_path: Path) -> None:
    cube = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 0.1
    inner = np.random.default_rng(0).uniform(-0.09, 0.09, (50, 3))
    vertices = " ".join(f"{x:.9g}" for x in np.vstack([cube, inner]).ravel())
    realization = robot(
        tmp_path,
        f"""<mujoco><asset><mesh name="m" vertex="{vertices}"/></asset><worldbody>
        <body name="a"><freejoint/><geom name="a" type="mesh" mesh="m"/></body>
        <body name="b"><freejoint/><geom name="b" type="sphere" size="0.1"/></body>
        </worldbody></mujoco>""",
    )
    shapes = collision.Shapes(realization)
    by_mujoco, by_coal = both_distances(realization, shapes, [0, 0, 0.5, 1, 0, 0, 0])
    assert by_mujoco == pytest.approx(0.3, abs=1e-6)
    assert by_coal == pytest.approx(0.3, abs=1e-6)


def test_a_height_field_is_refused_with_its_name(tmp_path: Path) -> None:
    realization = robot(
        tmp_path,
        """<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 1"/></asset><worldbody>
        <geom name="ground" type="hfield" hfield="h"/>
        <body name="b"><freejoint/><geom name="b" size="0.1"/></body></worldbody></mujoco>""",
    )
    spec = golden(
        CHECK,
        target={"pairs": [["ground", "b"]], "disabled": []},
        stimulus={"poses": ["reference"]},
        tolerance={"distance": "1 mm"},
    )
    words = r"ground: distances to this shape cannot be checked.*got .hfield.; expected plane"
    with pytest.raises(ModelError, match=words):
        measure(CHECK, spec, realization)


# -- the golden


def arm_spec(**target: object) -> object:
    return golden(
        CHECK,
        target={
            "pairs": [["turret", "forearm"], ["upper_arm", "palm"]],
            "disabled": [{"pair": ["right", "left"], "reason": "the fingers close on each other"}],
        }
        | target,
        stimulus={"poses": ["reference", "home", {"seed": 3, "count": 5}]},
        tolerance={"distance": "1 um", "penetration": "1 mm"},
    )


def test_an_unchanged_arm_passes_against_recorded_values_and_coal(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    measures = measure(CHECK, record(CHECK, arm_spec(), arm), arm)
    assert failed(measures) == []
    assert {(m.subject.split(" at ")[0], m.against) for m in measures} == {
        ("turret - forearm", "golden"),
        ("turret - forearm", "coal"),
        ("upper_arm - palm", "golden"),
        ("upper_arm - palm", "coal"),
        ("every disabled pair has its reason", "declared"),
    }


@pytest.mark.parametrize(
    ("old", "new", "pair"),
    [
        ('pos="0 0 0.1" size="0.025', 'pos="0 0 0.09" size="0.025', "turret - forearm"),
        ("0.04 0.02 0.01", "0.04 0.02 0.02", "upper_arm - palm"),
    ],
)
def test_a_changed_shape_fails_only_its_own_pair(
    tmp_path: Path, old: str, new: str, pair: str
) -> None:
    spec = record(CHECK, arm_spec(), robot(tmp_path))
    assert ARM.count(old) == 1
    faults = failed(measure(CHECK, spec, robot(tmp_path, ARM.replace(old, new))))
    assert faults
    assert {m.subject.split(" at ")[0] for m in faults} == {pair}
    assert {m.against for m in faults} == {"golden"}


def test_a_mesh_scaled_by_1000_fails(tmp_path: Path) -> None:
    text = f"""<mujoco><asset><mesh name="m" vertex="{WEDGE}" scale="1 1 1"/></asset><worldbody>
        <body name="a"><joint name="j"/><geom type="mesh" mesh="m"/></body>
        <body name="b" pos="0 0 1"><geom size="0.1"/></body></worldbody></mujoco>"""
    spec = golden(
        CHECK,
        target={"pairs": [["a", "b"]], "disabled": []},
        stimulus={"poses": ["reference"]},
        tolerance={"distance": "0.1 mm"},
    )
    spec = record(CHECK, spec, robot(tmp_path, text))
    huge = text.replace("1 1 1", "1000 1000 1000")
    faults = failed(measure(CHECK, spec, robot(tmp_path, huge)))
    assert next(m.against for m in faults if m.name == "distance") == "golden"
    assert failed(measure(CHECK, spec, robot(tmp_path, text))) == []


def test_wrong_distances_from_mujoco_fail_against_coal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = robot(tmp_path)
    right = collision.Shapes.distance
    monkeypatch.setattr(collision.Shapes, "distance", lambda *a: right(*a) + 1e-4)
    faults = failed(measure(CHECK, arm_spec(), arm))
    assert {m.against for m in faults} == {"coal"}
    assert all(m.error == pytest.approx(1e-4, rel=0.05) for m in faults)


def test_a_distance_that_is_not_finite_fails(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, arm_spec(), arm)
    observation = CHECK.observe(spec, arm, lambda fraction: None)
    observation.values["distance"]["turret - forearm"]["home"] = float("nan")
    faults = failed(CHECK.compare(spec, observation, None))
    assert {m.subject for m in faults} == {"turret - forearm at home"}


def test_a_disabled_collision_pair_without_a_reason_fails(tmp_path: Path) -> None:
    fault = failed(measure(CHECK, arm_spec(disabled=[]), robot(tmp_path)))
    assert [m.subject for m in fault] == [
        "left - right: an exclude element keeps them apart, and target.disabled gives no reason"
    ]


def test_pairs_disabled_by_collision_masks_need_a_reason(tmp_path: Path) -> None:
    masked = ARM.replace('name="turret" type', 'name="turret" contype="2" conaffinity="2" type')
    fault = failed(measure(CHECK, arm_spec(), robot(tmp_path, masked)))
    # Parent and child never collide: turret and upper arm are not listed.
    assert [m.subject.split(":")[0] for m in fault] == [
        "forearm - turret",
        "left - turret",
        "palm - turret",
        "right - turret",
    ]
    assert "contype and conaffinity keep them apart" in fault[0].subject


def test_one_reason_may_cover_all_pairs_among_several_bodies(tmp_path: Path) -> None:
    masked = ARM.replace('name="turret" type', 'name="turret" contype="2" conaffinity="2" type')
    disabled = [
        {"among": ["turret", "forearm", "palm", "left", "right"], "reason": "cannot meet"},
    ]
    assert failed(measure(CHECK, arm_spec(disabled=disabled), robot(tmp_path, masked))) == []


def test_a_reason_for_a_pair_that_can_collide_fails(tmp_path: Path) -> None:
    plain = ARM.replace('<exclude body1="left" body2="right"/>', "")
    assert [m.subject for m in failed(measure(CHECK, arm_spec(), robot(tmp_path, plain)))] == [
        "right - left: declared as disabled, but can collide"
    ]


def test_disabling_contact_globally_disables_all_pairs(tmp_path: Path) -> None:
    text = ARM.replace('<option timestep="0.001"/>', '<option><flag contact="disable"/></option>')
    arm = robot(tmp_path, text)
    pairs = collision.disabled_pairs(arm)
    # Palm and forearm are fixed together: both count as parents of the fingers and children of the
    # upper arm.
    assert [pair for pair, _ in pairs] == [
        ("forearm", "turret"),
        ("left", "right"),
        ("left", "turret"),
        ("left", "upper_arm"),
        ("palm", "turret"),
        ("right", "turret"),
        ("right", "upper_arm"),
    ]
    assert {why for _, why in pairs} == {"the option contact='disable' keeps them apart"}
    assert failed(measure(CHECK, from_first(CHECK, arm), arm)) == []


def test_disabled_pairs_consider_explicit_pairs_and_partial_masks(tmp_path: Path) -> None:
    text = """<mujoco><worldbody>
      <body name="a"><joint/><geom name="a0" size="0.1"/>
        <geom name="a1" size="0.1" contype="2" conaffinity="2"/></body>
      <body name="b"><joint/><geom name="b0" size="0.1"/></body>
      <body name="c"><joint/><geom name="c0" size="0.1" contype="4" conaffinity="4"/></body>
      <body name="drawn"><joint/><geom size="0.1" contype="0" conaffinity="0"/></body>
      </worldbody><contact><pair geom1="b0" geom2="c0"/></contact></mujoco>"""
    pairs = dict(collision.disabled_pairs(robot(tmp_path, text)))
    assert pairs == {
        ("a", "b"): "contype and conaffinity keep some of their geoms apart",
        ("a", "c"): "contype and conaffinity keep them apart",
    }


def test_a_flat_mesh_is_refused_with_its_name(tmp_path: Path) -> None:
    text = """<mujoco><asset>
      <mesh name="sheet" inertia="shell" vertex="0 0 0 1 0 0 0 1 0 1 1 0" face="0 1 2 1 3 2"/>
      </asset><worldbody><body name="a"><joint/><geom type="mesh" mesh="sheet" mass="1"/></body>
      <body name="b" pos="0 0 1"><geom size="0.1"/></body></worldbody></mujoco>"""
    spec = golden(
        CHECK,
        target={"pairs": [["a", "b"]], "disabled": []},
        stimulus={"poses": ["reference"]},
        tolerance={"distance": "1 mm"},
    )
    with pytest.raises(ModelError) as caught:
        measure(CHECK, spec, robot(tmp_path, text))
    assert "sheet" in str(caught.value)


def test_unnamed_bodies_are_identified_by_their_position_in_the_tree(tmp_path: Path) -> None:
    text = """<mujoco><worldbody><body name="a"><joint/><geom size="0.1"/></body>
      <body><joint/><geom size="0.1" contype="2" conaffinity="2"/></body></worldbody></mujoco>"""
    nameless = robot(tmp_path, text)
    [(pair, _)] = collision.disabled_pairs(nameless)
    assert set(pair) == {"a", next(b for b in nameless.structure.body_parent if b != "a")}
    spec = from_first(CHECK, nameless)
    assert failed(measure(CHECK, spec, nameless)) == []
    assert set(CHECK.depends(spec, nameless.structure)) <= set(nameless.parts)


def test_the_enabled_pairs_equal_the_pairs_that_mujoco_lets_collide(tmp_path: Path) -> None:
    """All bodies overlap: MuJoCo reports contact of exactly the enabled pairs."""
    masks = {"a": (1, 1), "b": (2, 1), "c": (2, 2), "d": (4, 3), "e": (0, 1), "f": (1, 0)}
    bodies = "".join(
        f'<body name="{n}"><joint type="slide"/><geom size="0.1" contype="{t}" conaffinity="{a}"/>'
        f'<body name="{n}2"><joint/><geom size="0.1"/></body></body>'
        for n, (t, a) in masks.items()
    )
    text = (
        f'<mujoco><worldbody><geom size="0.1"/>{bodies}</worldbody>'
        '<contact><exclude body1="a" body2="b2"/></contact></mujoco>'
    )
    heap = robot(tmp_path, text)
    data = mujoco.MjData(heap.model)
    mujoco.mj_forward(heap.model, data)
    touching = {
        tuple(sorted(heap.model.body(heap.model.geom_bodyid[g]).name for g in contact.geom))
        for contact in data.contact
    }
    assert set(collision.enabled_pairs(heap)) == touching
    assert not touching & {pair for pair, _ in collision.disabled_pairs(heap)}


def test_an_unknown_geom_is_refused_with_its_line(tmp_path: Path) -> None:
    spec = golden(
        CHECK,
        target={"pairs": [["turret", "forarm"]], "disabled": []},
        stimulus={"poses": ["reference"]},
        tolerance={"distance": "1 mm"},
        lines={"target.pairs.0": 7},
    )
    with pytest.raises(SpecError) as caught:
        measure(CHECK, spec, robot(tmp_path))
    assert str(caught.value) == (
        "golden/spec.yaml:7: target.pairs.0: no geom or collision body of this name "
        "(got 'forarm'; expected did you mean 'forearm'?)"
    )


def test_a_proposed_golden_passes_and_states_reasons_for_disabled_pairs(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, from_first(CHECK, arm), arm)
    assert failed(measure(CHECK, spec, arm)) == []
    [entry] = spec.target["disabled"]
    assert entry["pair"] == ["left", "right"]
    assert entry["reason"].startswith("an exclude element keeps them apart")
