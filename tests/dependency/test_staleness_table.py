"""One change of each kind, and exactly the goldens that it makes stale."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from dependency_map_of import dependency_map_of, proven

from pytest_twin.staleness import staleness

MODEL = """\
<mujoco model="arm">
  <compiler angle="radian" autolimits="true" meshdir="meshes"/>
  <option timestep="0.001" gravity="0 0 -9.81"/>
  <default>
    <geom friction="0.8 0.005 0.0001"/>
    <joint damping="0.5" armature="0.02"/>
    <default class="visual"><geom contype="0" conaffinity="0" rgba="0.2 0.2 0.2 1"/></default>
  </default>
  <asset>
    <mesh name="forearm" file="forearm.stl"/>
    <mesh name="cover" file="cover.stl"/>
  </asset>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="base" pos="0 0 0.05">
      <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
      <body name="turret" pos="0 0 0.1">
        <inertial pos="0 0 0.03" mass="0.6" diaginertia="0.001 0.001 0.001"/>
        <joint name="yaw" axis="0 0 1" range="-2.8 2.8"/>
        <body name="upper_arm" pos="0 0 0.1">
          <inertial pos="0 0 0.1" mass="1.5" diaginertia="0.01 0.01 0.001"/>
          <joint name="shoulder" axis="0 1 0" range="-1.7 1.9"/>
          <geom name="upper_arm" type="capsule" size="0.03" fromto="0 0 0.05 0 0 0.2"/>
          <body name="forearm" pos="0 0 0.25">
            <inertial pos="0 0 0.08" mass="0.5" diaginertia="0.002 0.002 0.0001"/>
            <joint name="elbow" axis="0 1 0" range="-2.4 2.4"/>
            <geom name="forearm" type="mesh" mesh="forearm"/>
            <geom class="visual" type="mesh" mesh="cover"/>
            <body name="palm" pos="0 0 0.2">
              <inertial pos="0 0 0.03" mass="0.2" diaginertia="0.0003 0.0002 0.0001"/>
              <joint name="wrist" axis="0 1 0" range="-1.9 1.9"/>
              <geom name="palm" type="box" size="0.03 0.02 0.02"/>
              <site name="tcp" pos="0 0 0.13"/>
              <body name="finger_left" pos="0 0.005 0.06">
                <inertial pos="0 0 0.03" mass="0.04" diaginertia="1e-5 1e-5 1e-5"/>
                <joint name="grip" type="slide" axis="0 1 0" range="0 0.03"/>
                <geom name="finger_left" type="box" size="0.01 0.004 0.03" pos="0 0 0.03"/>
              </body>
              <body name="finger_right" pos="0 -0.005 0.06">
                <inertial pos="0 0 0.03" mass="0.04" diaginertia="1e-5 1e-5 1e-5"/>
                <joint name="grip_right" type="slide" axis="0 -1 0" range="0 0.03"/>
                <geom name="finger_right" type="box" size="0.01 0.004 0.03" pos="0 0 0.03"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
    <body name="turntable" pos="1 0 0">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="spin" axis="0 0 1" limited="false"/>
      <geom class="visual" type="cylinder" size="0.2 0.01"/>
    </body>
  </worldbody>
  <equality>
    <joint name="mimic" joint1="grip_right" joint2="grip" polycoef="0 1 0 0 0"/>
  </equality>
  <actuator>
    <position name="yaw" joint="yaw" kp="100" ctrlrange="-2.8 2.8" forcerange="-12 12"/>
    <position name="shoulder" joint="shoulder" kp="200" ctrlrange="-1.7 1.9"/>
    <position name="elbow" joint="elbow" kp="100" ctrlrange="-2.4 2.4"/>
    <position name="wrist" joint="wrist" kp="50" ctrlrange="-1.9 1.9"/>
    <position name="grip" joint="grip" kp="500" ctrlrange="0 0.03"/>
    <motor name="spin" joint="spin"/>
  </actuator>
  <keyframe>
    <key name="ready" qpos="0 0.3 0.6 0 0.01 0.01 0"/>
  </keyframe>
</mujoco>
"""

TWIN = """\
model: arm.xml
tcp: tcp
controllers:
  soft: {elbow: {kp: 50}}
  stiff: {elbow: {kp: 400}}
payloads:
  kg05: {palm: {mass: 0.5, com: [0, 0, 0.05]}}
calibration:
  id: cal-1
  joints: {elbow: {offset: 0.01}, wrist: {offset: 0.02, sign: -1}}
fit:
  id: fit-1
  joint: {elbow: {frictionloss: 0.1}}
parts:
  firmware: {id: '3.10', affects: {kinds: [step, replay]}}
  table: {value: oak, affects: {goldens: [golden/touch*]}}
  gearbox: {id: 7, affects: {joints: [spin]}}
  room: {value: 22}
"""

GOLDENS = {
    "fk": """
kind: fk
target: {frames: [tcp]}
stimulus: {poses: [reference, {joints: {elbow: 0.3}}]}
tolerance: {position: 1 um, orientation: 1e-6 rad}
""",
    "fk_shoulder": """
kind: fk
target: {frames: [upper_arm]}
stimulus: {poses: [ready]}
tolerance: {position: 1 um, orientation: 1e-6 rad}
""",
    "direction": """
kind: joint_direction
target: {joints: {yaw: {frame: turret, rotation: [0, 0, 1]}}}
tolerance: {direction: 1 deg}
""",
    "limits": """
kind: limits
target: {joints: {elbow: {hard: [-2.4 rad, 2.4 rad]}}}
tolerance: {angle: 1e-6 rad}
""",
    "mass": """
kind: mass_properties
target: {}
stimulus: {poses: [reference]}
tolerance: {mass: 1 g, center_of_mass: 1 mm}
""",
    "settling": """
kind: settling
stimulus: {duration: 1 s}
tolerance: {angle: 1 mrad}
""",
    "step_elbow": """
kind: step
target: {joint: elbow}
stimulus: {amplitude: 5 deg, duration: 1 s}
tolerance: {angle: 1 mrad}
""",
    "step_spin": """
kind: step
target: {joint: spin}
stimulus: {amplitude: 0.1 N*m, duration: 1 s}
tolerance: {angular_velocity: 0.001 rad/s}
""",
    "response": """
kind: frequency_response
target: {joint: elbow}
stimulus: {amplitude: 1 deg, band: [1 Hz, 20 Hz], period: 1 s}
tolerance: {magnitude: 0.1 dB}
""",
    "touch": """
kind: contact
target: {primitive: approach, pair: [palm, table]}
stimulus: {duration: 1 s}
tolerance: {penetration: 0.1 mm}
""",
    "distance": """
kind: collision_distance
target:
  pairs: [[forearm, table]]
  disabled: []
stimulus: {poses: [reference]}
tolerance: {distance: 0.1 mm}
""",
    "distance_upper": """
kind: collision_distance
target:
  pairs: [[upper_arm, table]]
  disabled: []
stimulus: {poses: [reference]}
tolerance: {distance: 0.1 mm}
""",
    "replay_soft": """
kind: replay
target: {recording: recordings/soft.mcap, joints: [elbow], controller: soft}
tolerance: {angle_rms: 10 mrad}
""",
    "replay_load": """
kind: replay
target: {recording: recordings/load.mcap, joints: [elbow], controller: stiff, payload: kg05}
tolerance: {angle_rms: 10 mrad}
""",
    "pick": """
kind: task
target:
  function: tasks.py:pick
  outputs: {height: {unit: m, tolerance: 1 mm}}
""",
}

ALL = frozenset(GOLDENS)
# Goldens on the dynamics of the arm; the turntable has no contact and no coupling with it.
ARM = frozenset(
    {"limits", "settling", "step_elbow", "response", "touch", "replay_soft", "replay_load", "pick"}
)
DYNAMICS = ARM | {"step_spin"}
REPLAYS = frozenset({"replay_soft", "replay_load"})

Edit = Callable[[Path], None]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("table") / "arm"
    for folder in ("meshes", "golden", "recordings"):
        (root / folder).mkdir(parents=True)
    write_mesh(root / "meshes/forearm.stl", 0.2)
    write_mesh(root / "meshes/cover.stl", 0.22)
    (root / "arm.xml").write_text(MODEL)
    (root / "twin.yaml").write_text(TWIN)
    (root / "tasks.py").write_text("def pick(realization):\n    return {'height': 0.1}\n")
    for name in ("soft", "load"):
        # Only the digest of the file matters here.
        (root / f"recordings/{name}.mcap").write_bytes(name.encode())
    for name, text in GOLDENS.items():
        (root / f"golden/{name}.yaml").write_text(f"schema: 1{text}")
    return root


def write_mesh(path: Path, length: float) -> None:
    box = trimesh.creation.box(extents=(0.05, 0.04, length))
    box.apply_translation((0, 0, length / 2))
    path.write_bytes(box.export(file_type="stl"))


def replaced(file: str, old: str, new: str, count: int = 1) -> Edit:
    def edit(root: Path) -> None:
        text = (root / file).read_text()
        assert old in text
        (root / file).write_text(text.replace(old, new, count))

    return edit


def model(old: str, new: str) -> Edit:
    return replaced("arm.xml", old, new)


def twin(old: str, new: str) -> Edit:
    return replaced("twin.yaml", old, new)


def without_payloads(root: Path) -> None:
    path = root / "twin.yaml"
    path.write_text(re.sub(r"payloads:\n.*\n", "", path.read_text()))


def reformatted(root: Path) -> None:
    text = (root / "arm.xml").read_text()
    text = re.sub(r'(\w+)="([^"]*)" (\w+)="([^"]*)"', r"""\3='\4'\n   \1='\2'""", text)
    text = text.replace("<body", "<!-- moved -->\n<body")
    (root / "arm.xml").write_text(text)


def without_defaults(root: Path) -> None:
    """The same model without default classes and with an included file for the actuators."""
    text = (root / "arm.xml").read_text()
    text = text.replace('<joint damping="0.5" armature="0.02"/>', "")
    text = re.sub(
        r"(<body[^>]*>\s*<inertial[^>]*/>\s*<joint )",
        r'\1damping="0.5" armature="0.02" ',
        text,
    )
    actuators = re.search(r"<actuator>.*</actuator>", text, re.DOTALL)
    assert actuators is not None
    (root / "actuators.xml").write_text(f"<mujocoinclude>{actuators[0]}</mujocoinclude>")
    text = text.replace(actuators[0], '<include file="actuators.xml"/>')
    (root / "arm.xml").write_text(text)


def mesh(name: str) -> Edit:
    return lambda root: write_mesh(root / f"meshes/{name}.stl", 0.25)


def appended(file: str, data: bytes) -> Edit:
    def edit(root: Path) -> None:
        with (root / file).open("ab") as stream:
            stream.write(data)

    return edit


FILES: list[tuple[str, Edit, frozenset[str] | set[str]]] = [
    # changes without effect on any golden
    ("comment", model("<worldbody>", "<!-- ours --><worldbody>"), set()),
    ("colour", model('rgba="0.2 0.2 0.2 1"', 'rgba="0.9 0.1 0.1 1"'), set()),
    ("reformatted", reformatted, set()),
    ("without default classes, with an include", without_defaults, set()),
    ("visual mesh", mesh("cover"), set()),
    (
        "visual gets a name",
        model('class="visual" type="mesh"', 'name="c" class="visual" type="mesh"'),
        set(),
    ),
    (
        "additional visual geom",
        model("<site", '<geom class="visual" size="0.01" mass="0"/><site'),
        set(),
    ),
    ("camera", model('<site name="tcp"', '<camera name="eye"/><site name="tcp"'), set()),
    ("size of the drawn plane", model('size="1 1 0.1"', 'size="3 3 0.1"'), set()),
    ("twin comment", twin("tcp: tcp", "tcp: tcp  # tool"), set()),
    ("twin name", twin("tcp: tcp", "tcp: tcp\nname: other"), set()),
    ("spec comment", replaced("golden/fk.yaml", "kind: fk", "kind: fk  # ends"), set()),
    ("spec title", replaced("golden/fk.yaml", "kind: fk", "kind: fk\ntitle: ends"), set()),
    ("calibration id", twin("id: cal-1", "id: cal-2"), set()),
    ("fit id", twin("id: fit-1", "id: fit-2"), set()),
    # rigid bodies
    ("link mass", model('mass="0.5"', 'mass="0.6"'), ARM | {"mass"}),
    # A contact amplifies rounding errors, and the arm can touch the table.
    ("mass of the turntable", model('mass="1"', 'mass="1.1"'), DYNAMICS | {"mass"}),
    ("mass of the fixed base", model('mass="2"', 'mass="3"'), ARM | {"mass"}),
    ("inertia", model('"0.002 0.002', '"0.003 0.003'), ARM | {"mass"}),
    (
        "link length",
        model('name="palm" pos="0 0 0.2"', 'name="palm" pos="0 0 0.21"'),
        ARM | {"mass", "fk"},
    ),
    ("tool frame", model('name="tcp" pos="0 0 0.13"', 'name="tcp" pos="0 0 0.14"'), {"fk", "pick"}),
    ("axis", model('name="yaw" axis="0 0 1"', 'name="yaw" axis="0 0 -1"'), ALL - {"step_spin"}),
    # joints and actuators
    ("damping of all", model('damping="0.5"', 'damping="0.6"'), DYNAMICS),
    ("damping of one", model('name="elbow" axis', 'name="elbow" damping="0.6" axis'), ARM),
    (
        "range",
        model('range="-2.4 2.4"/>\n            <geom', 'range="-2.3 2.4"/>\n            <geom'),
        ARM,
    ),
    ("gain", model('joint="elbow" kp="100"', 'joint="elbow" kp="101"'), ARM),
    (
        "motor",
        model('<motor name="spin" joint="spin"/>', '<motor name="spin" joint="spin" gear="2"/>'),
        DYNAMICS,
    ),
    ("coupling", model('polycoef="0 1 0', 'polycoef="0 0.9 0'), ARM | {"mass"}),
    ("keyframe", model('qpos="0 0.3', 'qpos="0 0.4'), {"fk_shoulder", "pick"}),
    # options
    ("gravity", model("0 0 -9.81", "0 0 -9.8"), DYNAMICS | {"mass"}),
    (
        "timestep",
        model('timestep="0.001"', 'timestep="0.002"'),
        DYNAMICS | {"distance", "distance_upper"},
    ),
    (
        "minimum mass of the compiler",
        model('autolimits="true"', 'autolimits="true" boundmass="1e-4"'),
        REPLAYS | {"touch", "pick"},
    ),
    # contact
    ("friction", model('friction="0.8', 'friction="0.7'), ARM | {"distance", "distance_upper"}),
    ("mesh", mesh("forearm"), ARM | {"distance", "distance_upper"}),
    # the dependency set
    (
        "new body",
        model(
            '<site name="tcp"',
            '<body name="hook"><geom size="0.01" mass="0.1"/></body><site name="tcp"',
        ),
        ARM | {"mass", "distance", "distance_upper"},
    ),
    (
        "new exclude",
        model(
            "<equality>", '<contact><exclude body1="palm" body2="upper_arm"/></contact><equality>'
        ),
        ARM | {"distance", "distance_upper"},
    ),
    # declarations in the twin file
    ("controller", twin("kp: 50", "kp: 60"), {"replay_soft", "pick"}),
    ("payload", twin("mass: 0.5", "mass: 0.55"), {"replay_load", "pick"}),
    ("calibration", twin("offset: 0.01", "offset: 0.015"), REPLAYS | {"pick"}),
    ("fitted parameter", twin("frictionloss: 0.1", "frictionloss: 0.12"), ARM),
    ("firmware", twin("'3.10'", "'3.11'"), REPLAYS | {"step_elbow", "step_spin"}),
    ("table", twin("oak", "steel"), {"touch"}),
    ("gearbox", twin("id: 7", "id: 8"), DYNAMICS | {"mass"}),
    ("room", twin("value: 22", "value: 23"), ALL),
    (
        "new part",
        twin("parts:", "parts:\n  cell: {id: 1, affects: {kinds: [fk]}}"),
        {"fk", "fk_shoulder"},
    ),
    ("payload declarations removed", without_payloads, REPLAYS | {"pick"}),
    ("topics", twin("tcp: tcp", "tcp: tcp\ntopics: {state: /other}"), REPLAYS),
    # the goldens themselves
    ("tolerance", replaced("golden/mass.yaml", "1 g", "2 g"), {"mass"}),
    ("stimulus", replaced("golden/step_elbow.yaml", "5 deg", "6 deg"), {"step_elbow"}),
    ("recording", appended("recordings/soft.mcap", b"!"), {"replay_soft"}),
    ("code of a task", appended("tasks.py", b"\n# slower\n"), {"pick"}),
]


@pytest.fixture(scope="module")
def before(template: Path) -> object:
    return proven(dependency_map_of(template))


@pytest.mark.parametrize(("edit", "expected"), [c[1:] for c in FILES], ids=[c[0] for c in FILES])
def test_a_change_makes_exactly_the_expected_goldens_stale(
    template: Path, tmp_path: Path, before: object, edit: Edit, expected: set[str]
) -> None:
    root = tmp_path / "arm"
    shutil.copytree(template, root)
    edit(root)
    reasons = staleness(dependency_map_of(root), before)  # type: ignore[arg-type]
    stale = {key.split("/")[1].split("@")[0]: why for key, why in reasons.items() if why}
    assert set(stale) == expected, {
        "missed": expected - stale.keys(),
        "falsely stale": {name: [str(r) for r in stale[name]] for name in stale.keys() - expected},
    }


VERSIONS = [
    ("mujoco", ALL),
    ("pin", {"fk", "fk_shoulder", "mass"}),
    ("coal", {"distance", "distance_upper"}),
    ("numpy", ALL),
]


@pytest.mark.parametrize(("name", "expected"), VERSIONS)
def test_a_changed_library_version_makes_exactly_the_expected_goldens_stale(
    template: Path, before: object, name: str, expected: set[str]
) -> None:
    reasons = staleness(dependency_map_of(template, {name: "99"}), before)  # type: ignore[arg-type]
    assert {key.split("/")[1].split("@")[0] for key, why in reasons.items() if why} == expected
    assert all(r.new == "99" for why in reasons.values() for r in why)


def test_an_unchanged_twin_has_no_stale_golden(template: Path, before: object) -> None:
    assert not any(staleness(dependency_map_of(template), before).values())  # type: ignore[arg-type]


def test_without_a_release_all_goldens_are_stale(template: Path) -> None:
    reasons = staleness(dependency_map_of(template), None)
    assert {str(r) for why in reasons.values() for r in why} == {"no release yet"}


WORDS = [
    (model('mass="0.5"', 'mass="0.6"'), "mujoco/inertia:forearm: mass 0.5 -> 0.6 kg"),
    (
        model('name="elbow" axis', 'name="elbow" damping="0.6" axis'),
        "mujoco/joint:elbow: damping 0.5 -> 0.6 N*m*s/rad",
    ),
    (
        model("0 0 -9.81", "0 0 -9.8"),
        "mujoco/option:gravity: gravity [0, 0, -9.81] -> [0, 0, -9.8] m/s^2",
    ),
    (
        twin("frictionloss: 0.1", "frictionloss: 0.12"),
        "mujoco/joint:elbow: friction loss 0.1 -> 0.12 N*m",
    ),
    (twin("'3.10'", "'3.11'"), "declared:firmware: id 3.10 -> 3.11"),
    (twin("kp: 50", "kp: 60"), "controller:soft: elbow.kp 50 -> 60"),
    (twin("mass: 0.5", "mass: 0.55"), "payload:kg05: palm.mass 0.5 -> 0.55 kg"),
    (
        twin("offset: 0.01", "offset: 0.015"),
        "calibration:elbow: offset 0.01 -> 0.015 rad or m",
    ),
    (
        replaced("golden/mass.yaml", "1 g", "2 g"),
        "spec:golden/mass: tolerance.mass.bound 0.001 -> 0.002 kg",
    ),
    (
        model('range="-2.4 2.4"/>\n            <geom', 'range="-2.3 2.4"/>\n            <geom'),
        "mujoco/limit:elbow: range [-2.4, 2.4] -> [-2.3, 2.4] rad",
    ),
    (
        model(
            '<site name="tcp"',
            '<body name="hook"><geom size="0.01" mass="0.1"/></body><site name="tcp"',
        ),
        "mujoco/inertia:hook: dependency set changed: added",
    ),
    (
        model('<motor name="spin" joint="spin"/>', ""),
        "mujoco/actuator:spin: dependency set changed: removed",
    ),
]


@pytest.mark.parametrize(("edit", "words"), WORDS, ids=[words for _, words in WORDS])
def test_the_reason_for_staleness_names_part_field_and_values(
    template: Path, tmp_path: Path, before: object, edit: Edit, words: str
) -> None:
    root = tmp_path / "arm"
    shutil.copytree(template, root)
    edit(root)
    reasons = staleness(dependency_map_of(root), before)  # type: ignore[arg-type]
    assert words in {str(reason) for why in reasons.values() for reason in why}
