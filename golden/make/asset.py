"""Make the demo arm: meshes, the supplier's URDF and the MuJoCo realization, from one table.

Run ``python golden/make/asset.py``; the files that it writes are kept in the repository. It
shares no code with pytest_twin. Mass properties are exact for the meshes: signed tetrahedra
from the origin to every face (Mirtich 1996; Tonon 2004), density of each material in kg/m^3.

Units: m, kg, rad, N, N*m. Every link frame is the frame of its joint at zero.
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

FOLDER = Path(__file__).resolve().parent.parent
ALUMINIUM, PLASTIC, STEEL = 2700.0, 1150.0, 7800.0


def prism(sections: list[tuple[float, float, float]], axis: int, sides: int) -> np.ndarray:
    """Triangles (n, 3, 3) of a solid through cross-sections along an axis, outward normals.

    Args:
        sections: (position along the axis, half width, half depth), each in m.
        axis: 0, 1 or 2.
        sides: 4 for a box-like section, more for an ellipse.
    """
    turn = np.pi / 4 if sides == 4 else 0.0
    scale = np.sqrt(2.0) if sides == 4 else 1.0
    angle = turn + 2 * np.pi * np.arange(sides) / sides
    rings = []
    for position, width, depth in sections:
        ring = np.empty((sides, 3))
        ring[:, axis] = position
        ring[:, (axis + 1) % 3] = scale * width * np.cos(angle)
        ring[:, (axis + 2) % 3] = scale * depth * np.sin(angle)
        rings.append(ring)
    triangles = []
    for lower, upper in itertools.pairwise(rings):
        for i in range(sides):
            j = (i + 1) % sides
            triangles += [(lower[i], lower[j], upper[j]), (lower[i], upper[j], upper[i])]
    for i in range(1, sides - 1):
        triangles.append((rings[0][0], rings[0][i + 1], rings[0][i]))
        triangles.append((rings[-1][0], rings[-1][i], rings[-1][i + 1]))
    return np.array(triangles)


def mass_properties(triangles: np.ndarray, density: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass in kg, centre of mass (3,) in m, inertia about it (3, 3) in kg*m^2."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    mass = density * volume.sum()
    center = (volume[:, None] * (a + b + c) / 4.0).sum(axis=0) / volume.sum()
    total = a + b + c
    second = sum(np.einsum("ij,ik->ijk", v, v) for v in (a, b, c, total)) / 20.0
    moment = density * (volume[:, None, None] * second).sum(axis=0)
    moment -= mass * np.outer(center, center)
    return mass, center, np.trace(moment) * np.eye(3) - moment


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """Write binary STL, single precision, metres."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    with path.open("wb") as file:
        file.write(b"demo arm, metres".ljust(80, b" "))
        file.write(struct.pack("<I", len(triangles)))
        for n, t in zip(normal, triangles, strict=True):
            file.write(struct.pack("<12fH", *n, *t.reshape(-1), 0))


@dataclass(frozen=True)
class Link:
    """A link and the joint that carries it; ``joint`` is None for the base."""

    name: str
    density: float
    sections: list[tuple[float, float, float]]
    mesh_axis: int
    sides: int
    parent: str = ""
    joint: str = ""
    kind: str = "revolute"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: str = "0 0 1"
    lower: float = 0.0
    upper: float = 0.0
    velocity: float = 0.0
    effort: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    kp: float = 0.0
    kv: float = 0.0
    gear_ratio: float = 1.0
    mimic: str = ""


LINKS = [
    Link("base", ALUMINIUM, [(0.0, 0.06, 0.06), (0.02, 0.06, 0.06), (0.08, 0.035, 0.035)], 2, 24),
    Link(
        "turret",
        ALUMINIUM,
        [(0.0, 0.035, 0.035), (0.07, 0.03, 0.03)],
        2,
        24,
        "base",
        "base_yaw",
        origin=(0, 0, 0.08),
        axis="0 0 1",
        lower=-2.8,
        upper=2.8,
        velocity=3.0,
        effort=12.0,
        damping=0.6,
        friction=0.12,
        armature=0.02,
        kp=180.0,
        kv=9.0,
        gear_ratio=100.0,
    ),
    Link(
        "upper_arm",
        ALUMINIUM,
        [(-0.03, 0.022, 0.028), (0.2, 0.018, 0.022), (0.27, 0.018, 0.02)],
        2,
        4,
        "turret",
        "shoulder",
        origin=(0, 0, 0.07),
        axis="0 1 0",
        lower=-1.7,
        upper=1.9,
        velocity=3.0,
        effort=25.0,
        damping=0.8,
        friction=0.2,
        armature=0.03,
        kp=400.0,
        kv=18.0,
        gear_ratio=120.0,
    ),
    Link(
        "forearm",
        PLASTIC,
        [(-0.025, 0.02, 0.022), (0.16, 0.016, 0.018), (0.22, 0.016, 0.016)],
        2,
        4,
        "upper_arm",
        "elbow",
        origin=(0, 0, 0.25),
        axis="0 1 0",
        lower=-2.4,
        upper=2.4,
        velocity=4.0,
        effort=10.0,
        damping=0.3,
        friction=0.08,
        armature=0.01,
        kp=160.0,
        kv=6.0,
        gear_ratio=80.0,
    ),
    Link(
        "palm",
        PLASTIC,
        [(-0.02, 0.018, 0.02), (0.05, 0.02, 0.03), (0.08, 0.015, 0.045)],
        2,
        4,
        "forearm",
        "wrist",
        origin=(0, 0, 0.21),
        axis="0 1 0",
        lower=-1.9,
        upper=1.9,
        velocity=5.0,
        effort=4.0,
        damping=0.1,
        friction=0.03,
        armature=0.004,
        kp=60.0,
        kv=2.0,
        gear_ratio=50.0,
    ),
    Link(
        "finger_left",
        STEEL,
        [(0.0, 0.006, 0.004), (0.05, 0.006, 0.004), (0.06, 0.005, 0.003)],
        2,
        4,
        "palm",
        "finger_left_slide",
        "prismatic",
        (0, 0.005, 0.08),
        "0 1 0",
        0.0,
        0.035,
        velocity=0.2,
        effort=20.0,
        damping=8.0,
        friction=0.3,
        armature=0.05,
        kp=1500.0,
        kv=30.0,
    ),
    Link(
        "finger_right",
        STEEL,
        [(0.0, 0.006, 0.004), (0.05, 0.006, 0.004), (0.06, 0.005, 0.003)],
        2,
        4,
        "palm",
        "finger_right_slide",
        "prismatic",
        (0, -0.005, 0.08),
        "0 -1 0",
        0.0,
        0.035,
        velocity=0.2,
        effort=20.0,
        damping=8.0,
        friction=0.3,
        armature=0.05,
        mimic="finger_left_slide",
    ),
]
TCP_IN_PALM = (0.0, 0.0, 0.13)
TABLE_HALF_SIZE = (0.5, 0.5, 0.02)


def text(*values: float) -> str:
    """Numbers as XML attributes, 9 significant digits."""
    return " ".join(f"{float(value):.9g}" for value in values)


def inertial_of(link: Link) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass properties of the mesh as it is stored, in single precision."""
    triangles = prism(link.sections, link.mesh_axis, link.sides).astype(np.float32).astype(float)
    return mass_properties(triangles, link.density)


def urdf() -> ElementTree.Element:
    """Build the supplier's URDF, with the transmissions of its drives."""
    robot = ElementTree.Element("robot", name="demo_arm")
    for link in LINKS:
        mass, center, inertia = inertial_of(link)
        element = ElementTree.SubElement(robot, "link", name=link.name)
        inertial = ElementTree.SubElement(element, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=text(*center), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=text(mass))
        ElementTree.SubElement(
            inertial,
            "inertia",
            ixx=text(inertia[0, 0]),
            ixy=text(inertia[0, 1]),
            ixz=text(inertia[0, 2]),
            iyy=text(inertia[1, 1]),
            iyz=text(inertia[1, 2]),
            izz=text(inertia[2, 2]),
        )
        for role in ("visual", "collision"):
            geometry = ElementTree.SubElement(ElementTree.SubElement(element, role), "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=f"meshes/{link.name}.stl")
    for link in LINKS[1:]:
        joint = ElementTree.SubElement(robot, "joint", name=link.joint, type=link.kind)
        ElementTree.SubElement(joint, "parent", link=link.parent)
        ElementTree.SubElement(joint, "child", link=link.name)
        ElementTree.SubElement(joint, "origin", xyz=text(*link.origin), rpy="0 0 0")
        ElementTree.SubElement(joint, "axis", xyz=link.axis)
        ElementTree.SubElement(
            joint,
            "limit",
            lower=text(link.lower),
            upper=text(link.upper),
            velocity=text(link.velocity),
            effort=text(link.effort),
        )
        ElementTree.SubElement(
            joint, "dynamics", damping=text(link.damping), friction=text(link.friction)
        )
        if link.mimic:
            ElementTree.SubElement(joint, "mimic", joint=link.mimic, multiplier="1", offset="0")
    ElementTree.SubElement(robot, "link", name="tcp")
    tcp = ElementTree.SubElement(robot, "joint", name="palm_to_tcp", type="fixed")
    ElementTree.SubElement(tcp, "parent", link="palm")
    ElementTree.SubElement(tcp, "child", link="tcp")
    ElementTree.SubElement(tcp, "origin", xyz=text(*TCP_IN_PALM), rpy="0 0 0")
    for link in LINKS[1:]:
        if link.kind != "revolute":
            continue
        transmission = ElementTree.SubElement(robot, "transmission", name=f"{link.joint}_drive")
        ElementTree.SubElement(
            transmission, "type"
        ).text = "transmission_interface/SimpleTransmission"
        joint = ElementTree.SubElement(transmission, "joint", name=link.joint)
        interface = "hardware_interface/PositionJointInterface"
        ElementTree.SubElement(joint, "hardwareInterface").text = interface
        motor = ElementTree.SubElement(transmission, "actuator", name=f"{link.joint}_motor")
        ElementTree.SubElement(motor, "mechanicalReduction").text = text(link.gear_ratio)
    return robot


def mjcf() -> ElementTree.Element:
    """Build the MuJoCo realization: drives as position servos, the mimic pair, the table."""
    model = ElementTree.Element("mujoco", model="demo_arm")
    ElementTree.SubElement(model, "compiler", angle="radian", meshdir="meshes", autolimits="true")
    ElementTree.SubElement(model, "option", timestep="0.001", integrator="implicitfast")
    default = ElementTree.SubElement(model, "default")
    ElementTree.SubElement(default, "geom", friction="0.8 0.005 0.0001", group="3")
    asset = ElementTree.SubElement(model, "asset")
    for link in LINKS:
        ElementTree.SubElement(asset, "mesh", name=link.name, file=f"{link.name}.stl")
    world = ElementTree.SubElement(model, "worldbody")
    ElementTree.SubElement(
        world,
        "geom",
        name="table",
        type="box",
        size=text(*TABLE_HALF_SIZE),
        pos=text(0, 0, -TABLE_HALF_SIZE[2]),
    )
    bodies: dict[str, ElementTree.Element] = {}
    for link in LINKS:
        mass, center, inertia = inertial_of(link)
        parent = bodies[link.parent] if link.parent else world
        body = ElementTree.SubElement(parent, "body", name=link.name, pos=text(*link.origin))
        bodies[link.name] = body
        ElementTree.SubElement(
            body,
            "inertial",
            pos=text(*center),
            mass=text(mass),
            fullinertia=text(
                inertia[0, 0],
                inertia[1, 1],
                inertia[2, 2],
                inertia[0, 1],
                inertia[0, 2],
                inertia[1, 2],
            ),
        )
        if link.joint:
            ElementTree.SubElement(
                body,
                "joint",
                name=link.joint,
                axis=link.axis,
                type="hinge" if link.kind == "revolute" else "slide",
                range=text(link.lower, link.upper),
                damping=text(link.damping),
                frictionloss=text(link.friction),
                armature=text(link.armature),
            )
        ElementTree.SubElement(body, "geom", name=link.name, type="mesh", mesh=link.name)
    ElementTree.SubElement(bodies["palm"], "site", name="tcp", pos=text(*TCP_IN_PALM), size="0.004")
    contact = ElementTree.SubElement(model, "contact")
    # The base is bolted to the table; the fingers share the palm's guide.
    ElementTree.SubElement(contact, "exclude", name="base_on_table", body1="world", body2="base")
    equality = ElementTree.SubElement(model, "equality")
    ElementTree.SubElement(
        equality,
        "joint",
        name="gripper_mimic",
        joint1="finger_right_slide",
        joint2="finger_left_slide",
        polycoef="0 1 0 0 0",
        solref="0.004 1",
        solimp="0.99 0.999 0.0001",
    )
    actuator = ElementTree.SubElement(model, "actuator")
    for link in LINKS[1:]:
        if link.mimic:
            continue
        ElementTree.SubElement(
            actuator,
            "position",
            name=link.joint,
            joint=link.joint,
            kp=text(link.kp),
            kv=text(link.kv),
            ctrlrange=text(link.lower, link.upper),
            forcerange=text(-link.effort, link.effort),
        )
    return model


def main() -> None:
    """Write every file of the asset."""
    (FOLDER / "meshes").mkdir(exist_ok=True)
    for link in LINKS:
        triangles = prism(link.sections, link.mesh_axis, link.sides)
        write_stl(FOLDER / "meshes" / f"{link.name}.stl", triangles)
    for name, root in (("arm.urdf", urdf()), ("arm.xml", mjcf())):
        ElementTree.indent(root)
        (FOLDER / name).write_text(ElementTree.tostring(root, encoding="unicode") + "\n")


if __name__ == "__main__":
    main()
