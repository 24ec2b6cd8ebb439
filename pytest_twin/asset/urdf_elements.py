"""Table of all elements and attributes of URDF files, and where each is converted to.

Sources: urdfdom's ``urdf.xsd`` and parser (with the limits of URDF 1.2), the draft of URDF sensors,
the SRDF specification of MoveIt, ros_control's and ros2_control's component parsers, the extension
tags of sdformat's URDF parser, MuJoCo's block in a URDF, and PyBullet's contact elements.

Paths are relative to ``robot``. A final ``/**`` means the element with all its descendants, a
final ``/*`` every other child.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

TEXT = "text()"
"""Represents the text of the element instead of an attribute."""


@dataclass(frozen=True, slots=True)
class Destination:
    """How realizations represent an element or attribute.

    Attributes:
        row: row of the semantic-loss matrix, None if every realization preserves it.
        code: code of the audit finding, None if the row suffices.
        settle: next step.
    """

    row: str | None = None
    code: str | None = None
    why: str = ""
    settle: str = ""


CARRIED = Destination()
NAMES = Destination()
"""Preserved as a name or structure that other elements refer to."""
APPLIED = Destination()
"""Applied to the robot before it is written, so that every realization includes it."""
SPEEDS = Destination("velocity limits")
SOFT_LIMITS = Destination("safety controllers")
REDUCTIONS = Destination("transmissions")
SENSORS = Destination("sensors")
CONTACT = Destination(
    "contact materials",
    "meshes.contact_setting",
    "contact in a simulator that does not read it has the engine's default friction and stiffness",
    "state friction and stiffness in the model of each simulator, and test one contact",
)
DRIVE = Destination(
    "drive elements",
    "transmissions.drive_element",
    "no realization preserves it: the simulated drive lacks this part of the real one",
    "state it in the model (armature, actuator gear, reference position), or fit it to a recording",
)
CALIBRATION = Destination(
    "joint calibration",
    "joints.calibration",
    "no realization preserves it: the zero of the real joint depends on it",
    "state the offset under `calibration:` in twin.yaml",
)
DYNAMIC_LIMITS = Destination(
    "acceleration limits",
    "joints.dynamic_limit",
    "no realization preserves it: a simulated command may accelerate faster than the real joint",
    "bound the commands where they are made, or give the controller in twin.yaml this limit",
)
QUATERNION = Destination(
    "orientations as quaternions",
    "frames.quaternion",
    "parsers read a quaternion only at a robot of version 1.1 or higher: this one is ignored",
    'state the same orientation as `rpy`, or add version="1.1" to the robot',
)
INTERFACES = Destination(
    "controller interfaces",
    "controllers.interface_setting",
    "no realization preserves it: the driver of the real robot obeys it",
    "give the controller in twin.yaml the same limits, rates and initial values",
)
SIMULATOR = Destination(
    "simulator settings",
    "controllers.simulator_setting",
    "only Gazebo applies it: the same robot moves differently in another simulator",
    "state it in the model of each simulator, or remove it",
)
PLANNING = Destination(
    "planning settings",
    "controllers.planning_setting",
    "it belongs in an SRDF: no realization preserves it",
    "move it into the SRDF; state poses and excluded pairs in the twin where goldens need them",
)
DESCRIPTION = Destination(
    "descriptive elements",
    "controllers.descriptive",
    "no realization preserves it; nothing that moves depends on it",
    "nothing, unless a tool of yours reads it",
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One element or attribute.

    Attributes:
        path: below ``robot``, ``joint/limit``.
        attribute: its name, :data:`TEXT` for the element's text, None for the element itself.
        sample: a valid value other than its default.
        neutral: a value without effect, None if every value has an effect.
        is_physical: whether it affects the robot's motion.
    """

    path: str
    attribute: str | None
    sample: str
    goes: Destination
    neutral: str | None = None
    is_physical: bool = False

    @property
    def label(self) -> str:
        """Return ``path@attribute``, such as ``joint/limit@lower``, or only the path."""
        alone = self.attribute in (None, TEXT)
        return self.path if alone else f"{self.path}@{self.attribute}"


def _attributes(path: str, goes: Destination, values: str, *, physics: bool = False) -> list[Entry]:
    """Build entries of one element from ``name=value; name=value``."""
    found = []
    for pair in values.split(";"):
        name, _, value = pair.strip().partition("=")
        found.append(Entry(path, name, value, goes, None, physics))
    return found


def _texts(
    path: str, goes: Destination, values: str, *, physics: bool = False, neutral: str | None = None
) -> list[Entry]:
    """Build entries of child elements with text, from ``tag=value; tag=value``."""
    found = []
    for pair in values.split(";"):
        name, _, value = pair.strip().partition("=")
        found.append(Entry(f"{path}/{name}", TEXT, value, goes, neutral, physics))
    return found


def _shapes(role: str) -> list[Entry]:
    at = f"link/{role}/geometry"
    return [
        *_attributes(f"link/{role}", NAMES, "name=shape"),
        *_attributes(f"link/{role}/origin", CARRIED, "xyz=0.01 0.02 0.03; rpy=0.1 0.2 0.3"),
        *_attributes(f"link/{role}/origin", QUATERNION, "quat_xyzw=0 0 0.6 0.8", physics=True),
        *_attributes(f"{at}/box", CARRIED, "size=0.1 0.2 0.3"),
        *_attributes(f"{at}/cylinder", CARRIED, "radius=0.1; length=0.3"),
        *_attributes(f"{at}/capsule", CARRIED, "radius=0.11; length=0.31"),
        *_attributes(f"{at}/sphere", CARRIED, "radius=0.12"),
        *_attributes(f"{at}/mesh", CARRIED, "filename=part.stl; scale=0.5 0.5 0.5"),
    ]


_URDF: list[Entry] = [
    *_attributes("", NAMES, "name=table"),
    *_attributes("", DESCRIPTION, "version=1.0"),
    *_attributes("link", NAMES, "name=arm"),
    *_attributes("link", DESCRIPTION, "type=laser"),
    *_attributes("link/inertial/origin", CARRIED, "xyz=0.01 0.02 0.03; rpy=0.1 0.2 0.3"),
    *_attributes("link/inertial/origin", QUATERNION, "quat_xyzw=0 0 0.6 0.8", physics=True),
    *_attributes("link/inertial/mass", CARRIED, "value=2.5"),
    *_attributes(
        "link/inertial/inertia",
        CARRIED,
        "ixx=0.03; ixy=0.001; ixz=0.002; iyy=0.04; iyz=0.003; izz=0.035",
    ),
    *_shapes("visual"),
    *_shapes("collision"),
    *_attributes("link/visual/material", NAMES, "name=paint"),
    *_attributes("link/visual/material/color", CARRIED, "rgba=0.1 0.2 0.3 1"),
    *_attributes("link/visual/material/texture", DESCRIPTION, "filename=paint.png"),
    *_attributes("link/collision/verbose", DESCRIPTION, "value=true"),
    *_attributes("material", NAMES, "name=paint"),
    *_attributes("material/color", CARRIED, "rgba=0.4 0.5 0.6 1"),
    *_attributes("material/texture", DESCRIPTION, "filename=paint.png"),
    *_attributes("joint", NAMES, "name=j; type=revolute"),
    *_attributes("joint/origin", CARRIED, "xyz=0.01 0.02 0.03; rpy=0.1 0.2 0.3"),
    *_attributes("joint/origin", QUATERNION, "quat_xyzw=0 0 0.6 0.8", physics=True),
    *_attributes("joint/parent", NAMES, "link=base"),
    *_attributes("joint/child", NAMES, "link=arm"),
    *_attributes("joint/axis", CARRIED, "xyz=0 1 0"),
    *_attributes("joint/limit", CARRIED, "lower=-0.7; upper=0.9; effort=12"),
    *_attributes("joint/limit", SPEEDS, "velocity=3"),
    *_attributes("joint/limit", DYNAMIC_LIMITS, "acceleration=4; deceleration=5; jerk=60"),
    *_attributes("joint/dynamics", CARRIED, "damping=0.3; friction=0.2"),
    *_attributes("joint/calibration", CALIBRATION, "rising=0.4; falling=0.5"),
    *_attributes("joint/calibration", CALIBRATION, "reference_position=0.6", physics=True),
    *_attributes(
        "joint/safety_controller",
        SOFT_LIMITS,
        "soft_lower_limit=-0.6; soft_upper_limit=0.8; k_position=10; k_velocity=20",
    ),
    *_attributes("joint/mimic", CARRIED, "joint=j; multiplier=0.5; offset=0.1"),
]

_SENSOR: list[Entry] = [
    *_attributes("sensor", SENSORS, "name=eye; type=camera"),
    *_attributes("sensor", Destination("sensor settings", "controllers.sensor_setting"), "id=3"),
    *_attributes(
        "sensor", Destination("sensor settings", "controllers.sensor_setting"), "update_rate=30"
    ),
    *_attributes("sensor/parent", SENSORS, "link=arm"),
    *_attributes("sensor/origin", SENSORS, "xyz=0 0 0.1; rpy=0 0 0.2"),
    *_attributes(
        "sensor/camera/image",
        Destination("sensor settings", "controllers.sensor_setting"),
        "width=640; height=480; format=RGB8; hfov=1.5; near=0.01; far=50",
    ),
    *_attributes(
        "sensor/ray/horizontal",
        Destination("sensor settings", "controllers.sensor_setting"),
        "samples=100; resolution=1; min_angle=-1.5; max_angle=1.5",
    ),
    *_attributes(
        "sensor/ray/vertical",
        Destination("sensor settings", "controllers.sensor_setting"),
        "samples=2; resolution=1; min_angle=-0.1; max_angle=0.1",
    ),
]

_TRANSMISSION: list[Entry] = [
    *_attributes("transmission", NAMES, "name=t; type=SimpleTransmission"),
    Entry("transmission/type", TEXT, "transmission_interface/SimpleTransmission", REDUCTIONS),
    *_attributes("transmission/joint", NAMES, "name=j"),
    *_attributes("transmission/actuator", NAMES, "name=motor"),
    Entry("transmission/mechanicalReduction", TEXT, "20", REDUCTIONS),
    Entry("transmission/joint/mechanicalReduction", TEXT, "21", REDUCTIONS),
    Entry("transmission/actuator/mechanicalReduction", TEXT, "22", REDUCTIONS),
    *_texts("transmission/joint", INTERFACES, "hardwareInterface=EffortJointInterface"),
    *_texts("transmission/actuator", INTERFACES, "hardwareInterface=EffortJointInterface"),
    *_texts("transmission/joint", DRIVE, "offset=0.1", physics=True, neutral="0"),
    *_texts("transmission/joint", DRIVE, "role=joint1"),
    *_texts("transmission/actuator", DRIVE, "role=actuator1"),
    *_texts("transmission/actuator", DRIVE, "motorInertia=0.001", physics=True, neutral="0"),
    *_texts("transmission", DRIVE, "motorTorqueConstant=0.06; pulsesPerRevolution=4096"),
    *_attributes("transmission/leftActuator", DRIVE, "name=left; mechanicalReduction=30"),
    *_attributes("transmission/rightActuator", DRIVE, "name=right; mechanicalReduction=30"),
    *_attributes("transmission/flexJoint", DRIVE, "name=j; mechanicalReduction=1"),
    *_attributes("transmission/rollJoint", DRIVE, "name=j; mechanicalReduction=1"),
    *_attributes(
        "transmission/gap_joint",
        DRIVE,
        "name=gap; L0=0.03; a=0.06; b=0.02; gear_ratio=29; h=0.2; mechanical_reduction=1; phi0=0.5;"
        "r=0.09; screw_reduction=0.001; t0=-0.0001; theta0=0.7",
    ),
    *_attributes("transmission/passive_joint", DRIVE, "name=j"),
    *_attributes(
        "transmission/simulated_actuated_joint",
        DRIVE,
        "name=j; passive_actuated_joint=j; simulated_reduction=3000",
    ),
    *_attributes(
        "transmission/compensator",
        DRIVE,
        "k_belt=4000; kd_motor=10; lambda_combined=0; lambda_joint=60; lambda_motor=60; "
        "mass_motor=0.05",
    ),
    Entry("transmission/use_simulated_gripper_joint", None, "", DRIVE),
]

_ROS2_CONTROL: list[Entry] = [
    *_attributes("ros2_control", INTERFACES, "name=system; type=system"),
    *_attributes("ros2_control", INTERFACES, "rw_rate=500; is_async=true"),
    *_texts("ros2_control/hardware", INTERFACES, "plugin=mock_components/GenericSystem; group=g"),
    Entry("ros2_control/hardware/param", TEXT, "0.01", INTERFACES),
    *_attributes("ros2_control/hardware/param", NAMES, "name=delay"),
    Entry("ros2_control/hardware/properties/**", None, "", INTERFACES),
    *_attributes("ros2_control/joint", NAMES, "name=j"),
    *_attributes("ros2_control/joint", INTERFACES, "mimic=true"),
    *_attributes("ros2_control/joint/limits", INTERFACES, "enable=false"),
    *_attributes("ros2_control/joint/param", NAMES, "name=torque_constant"),
    Entry("ros2_control/joint/param", TEXT, "0.06", INTERFACES, None, True),
    *_attributes("ros2_control/gpio", INTERFACES, "name=io"),
    *_attributes("ros2_control/gpio/param", NAMES, "name=vacuum"),
    Entry("ros2_control/gpio/param", TEXT, "1", INTERFACES),
    *_attributes("ros2_control/sensor", INTERFACES, "name=wrench"),
    *_attributes("ros2_control/sensor/param", NAMES, "name=frame_id"),
    Entry("ros2_control/sensor/param", TEXT, "arm", INTERFACES),
    *[
        entry
        for owner in ("joint", "gpio", "sensor")
        for kind in ("command_interface", "state_interface")
        for at in (f"ros2_control/{owner}/{kind}",)
        for entry in (
            *_attributes(at, INTERFACES, "name=position"),
            *_attributes(at, INTERFACES, "data_type=double; size=1"),
            *_attributes(f"{at}/limits", INTERFACES, "enable=true"),
            *_attributes(f"{at}/param", NAMES, "name=min"),
            Entry(f"{at}/param", TEXT, "-0.5", INTERFACES, None, kind == "command_interface"),
        )
        if (owner, kind) != ("sensor", "command_interface")
    ],
    *_attributes("ros2_control/transmission", DRIVE, "name=t"),
    *_texts("ros2_control/transmission", DRIVE, "plugin=transmission_interface/SimpleTransmission"),
    *_attributes("ros2_control/transmission/param", NAMES, "name=p"),
    Entry("ros2_control/transmission/param", TEXT, "1", DRIVE),
    *[
        entry
        for part in ("joint", "actuator")
        for at in (f"ros2_control/transmission/{part}",)
        for entry in (
            *_attributes(at, NAMES, "name=j"),
            *_attributes(at, DRIVE, "role=joint1"),
            *_texts(at, DRIVE, "mechanical_reduction=50", physics=True, neutral="1"),
            *_texts(at, DRIVE, "offset=0.05", physics=True, neutral="0"),
        )
    ],
]

_GAZEBO: list[Entry] = [
    *_attributes("gazebo", NAMES, "reference=arm"),
    *_texts(
        "gazebo",
        CONTACT,
        "mu1=0.7; mu2=0.6; kp=100000; kd=10; maxVel=0.01; minDepth=0.001; maxContacts=10; "
        "fdir1=1 0 0",
    ),
    *_texts("gazebo", SIMULATOR, "turnGravityOff=true", physics=True, neutral="false"),
    *_texts("gazebo", SIMULATOR, "gravity=false", physics=True, neutral="true"),
    *_texts("gazebo", SIMULATOR, "static=true; kinematic=true", physics=True, neutral="false"),
    *_texts("gazebo", SIMULATOR, "dampingFactor=0.02", physics=True, neutral="0"),
    *_texts("gazebo", SIMULATOR, "springStiffness=5", physics=True, neutral="0"),
    *_texts("gazebo", SIMULATOR, "springReference=0.1; fudgeFactor=0.5"),
    *_texts("gazebo", SIMULATOR, "stopCfm=0.1; stopErp=0.2"),
    *_texts("gazebo", SIMULATOR, "implicitSpringDamper=true; cfmDamping=true"),
    *_texts("gazebo", SIMULATOR, "provideFeedback=true; selfCollide=true; self_collide=true"),
    *_texts("gazebo", SIMULATOR, "disableFixedJointLumping=true; preserveFixedJoint=true"),
    *_texts("gazebo", DESCRIPTION, "material=Gazebo/Blue; laserRetro=1; canonicalBody=arm"),
    Entry("gazebo/plugin/**", None, "", SIMULATOR),
    Entry("gazebo/sensor/**", None, "", SENSORS),
    Entry("gazebo/visual/**", None, "", DESCRIPTION),
    Entry("gazebo/collision/**", None, "", CONTACT),
    Entry("gazebo/*", None, "", SIMULATOR),
]

_MUJOCO: list[Entry] = [
    *_attributes("mujoco/compiler", NAMES, "meshdir=.; assetdir=.; texturedir=.; strippath=false"),
    *_attributes("mujoco/compiler", APPLIED, "balanceinertia=true; boundmass=0.001"),
    *_attributes("mujoco/compiler", APPLIED, "boundinertia=0.000001"),
    *_attributes("mujoco/compiler", DESCRIPTION, "discardvisual=true; fusestatic=false"),
    *_attributes("mujoco/compiler", DESCRIPTION, "angle=radian; eulerseq=xyz; coordinate=local"),
    *_attributes("mujoco/compiler", DESCRIPTION, "usethread=true; alignfree=false"),
    Entry("mujoco/option/**", None, "", APPLIED),
    Entry("mujoco/size/**", None, "", DESCRIPTION),
]

_PYBULLET: list[Entry] = [
    *[
        Entry(f"link/contact/{tag}", "value", value, CONTACT)
        for tag, value in (
            ("lateral_friction", "0.8"),
            ("rolling_friction", "0.01"),
            ("spinning_friction", "0.02"),
            ("restitution", "0.3"),
            ("stiffness", "30000"),
            ("damping", "1000"),
            ("contact_cfm", "0.1"),
            ("contact_erp", "0.9"),
            ("inertia_scaling", "3"),
        )
    ],
]

_SRDF: list[Entry] = [
    *_attributes("group", PLANNING, "name=all"),
    *_attributes("group/link", PLANNING, "name=arm"),
    *_attributes("group/joint", PLANNING, "name=j"),
    *_attributes("group/group", PLANNING, "name=part"),
    *_attributes("group/chain", PLANNING, "base_link=base; tip_link=arm"),
    *_attributes("group_state", PLANNING, "name=home; group=all"),
    *_attributes("group_state/joint", PLANNING, "name=j; value=0.2"),
    *_attributes(
        "end_effector", PLANNING, "name=hand; parent_link=arm; group=hand; parent_group=all"
    ),
    *_attributes(
        "virtual_joint", PLANNING, "name=v; type=fixed; parent_frame=world; child_link=base"
    ),
    *_attributes("passive_joint", PLANNING, "name=j", physics=True),
    *_attributes("disable_collisions", PLANNING, "link1=base; link2=arm; reason=Adjacent"),
    *_attributes("enable_collisions", PLANNING, "link1=base; link2=arm"),
    *_attributes("disable_default_collisions", PLANNING, "link=arm"),
    *_attributes("link_sphere_approximation", PLANNING, "link=arm"),
    *_attributes("link_sphere_approximation/sphere", PLANNING, "center=0 0 0; radius=0.1"),
    *_attributes("joint_property", PLANNING, "joint_name=j; property_name=weight; value=0.5"),
]

ENTRIES: tuple[Entry, ...] = (
    *_URDF,
    *_SENSOR,
    *_TRANSMISSION,
    *_ROS2_CONTROL,
    *_GAZEBO,
    *_MUJOCO,
    *_PYBULLET,
    *_SRDF,
)


@cache
def by_path() -> dict[tuple[str, str | None], Entry]:
    """Return (path, attribute) -> its entry."""
    return {(entry.path, entry.attribute): entry for entry in ENTRIES}


@cache
def known_paths() -> frozenset[str]:
    """Return all paths of the table and their parents."""
    found: set[str] = set()
    for entry in ENTRIES:
        parts = entry.path.removesuffix("/**").removesuffix("/*").split("/")
        found.update("/".join(parts[: end + 1]) for end in range(len(parts)))
    return frozenset(found)
