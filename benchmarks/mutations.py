"""Mutation test of the asset properties: do they detect importer faults?

    python benchmarks/mutations.py --mutations 1000 --seed 1

The benchmark takes random robots and those of example-robot-data, injects one fault into one
realization (MuJoCo, Pinocchio or USD), and runs the properties of ``asset_properties``. The size of
a fault is measured independently, by Pinocchio on the two texts. Faults within the stated
tolerances need not be detected and are counted separately. The properties also run on every
unchanged robot; failures there are false alarms.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
import math
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from hypothesis import HealthCheck, Phase, given, seed, settings
from lxml import etree

from pytest_twin.asset.normalize import normalize
from pytest_twin.errors import TwinError
from pytest_twin.properties import PROPERTIES, Asset, Broken, Form, Tolerances
from pytest_twin.properties.form import mujoco_form, pinocchio_form, text_form, usd_form
from pytest_twin.realization import usd
from pytest_twin.strategies import configurations, robots

Element = Any
Rng = np.random.Generator
Key = tuple[str, str, str, str]

PER_ROBOT = 16
DRAWN = 2  # number of configurations for each robot, in addition to the generic one
MEASURED = 40  # number of configurations at which the size of a fault is measured
ENDLESS = 1e10  # larger bounds (rad, m, ...) are no bounds
HEAVY = 400_000  # size of a mesh, bytes, above which it is left out
MOST_JOINTS = 60  # number of joints of a real robot, including fixed ones
TARGETS: Mapping[str, tuple[Callable[[Path], Form], float]] = {
    "MuJoCo": (mujoco_form, 0.5),
    "Pinocchio": (pinocchio_form, 0.35),
    "USD": (usd_form, 0.15),
}
# Properties of a joint that each form can represent; faults in others are not visible.
CARRIES = {
    "MuJoCo": {"links", "shapes", "range", "effort", "damping", "friction", "mimic"},
    "Pinocchio": {"shapes", "range", "velocity", "effort", "damping", "friction"},
    "USD": {"links", "shapes", "range", "velocity", "damping", "friction", "mimic"},
}


# -- faults: edits of a URDF, by kind


def pick(rng: Rng, items: list[Any]) -> Any:
    return items[int(rng.integers(len(items)))] if items else None


def numbers(element: Element | None, key: str, default: str) -> list[float]:
    text = default if element is None else element.get(key, default)
    return [float(word) for word in text.split()]


def write(element: Element, key: str, values: Any) -> None:
    element.set(key, " ".join(repr(float(value)) for value in np.atleast_1d(values)))


def child(element: Element, tag: str) -> Element:
    found = element.find(tag)
    return etree.SubElement(element, tag) if found is None else found


def joints(root: Element, *kinds: str) -> list[Element]:
    return [joint for joint in root.findall("joint") if joint.get("type") in kinds]


def moving(root: Element) -> list[Element]:
    return joints(root, "revolute", "continuous", "prismatic")


def heavy(root: Element) -> list[Element]:
    return [
        link
        for link in root.findall("link")
        if link.find("inertial/mass") is not None
        and float(link.find("inertial/mass").get("value")) > 0
    ]


def small(rng: Rng, low: float = -9.0, high: float = -1.0) -> float:
    """Draw a size from far below to far above every tolerance, of either sign."""
    return float(10 ** rng.uniform(low, high) * rng.choice([-1.0, 1.0]))


def sign_flip(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, moving(root))
    if joint is None:
        return None
    axis = child(joint, "axis")
    write(axis, "xyz", [-value for value in numbers(axis, "xyz", "1 0 0")])
    return joint.get("name")


def swapped_axis(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, moving(root))
    if joint is None:
        return None
    axis = child(joint, "axis")
    order = pick(rng, [(1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1)])
    write(axis, "xyz", np.array(numbers(axis, "xyz", "1 0 0"))[list(order)])
    return joint.get("name")


def millimetre_offset(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, root.findall("joint"))
    if joint is None:
        return None
    origin = child(joint, "origin")
    factor = pick(rng, [1000.0, 0.001])
    write(origin, "xyz", factor * np.array(numbers(origin, "xyz", "0 0 0")))
    return joint.get("name")


def millimetre_shape(root: Element, rng: Rng) -> str | None:
    shape = pick(rng, root.findall("link/collision/geometry/*"))
    if shape is None:
        return None
    factor = pick(rng, [1000.0, 0.001]) if shape.tag != "mesh" else 1000.0
    keys = {"mesh": ["scale"], "box": ["size"], "sphere": ["radius"]}
    for key in keys.get(shape.tag, ["radius", "length"]):
        write(shape, key, factor * np.array(numbers(shape, key, "1 1 1")))
    return shape.getparent().getparent().getparent().get("name")


def shifted_inertia(root: Element, rng: Rng) -> str | None:
    link = pick(rng, heavy(root))
    if link is None:
        return None
    origin = child(link.find("inertial"), "origin")
    com = np.array(numbers(origin, "xyz", "0 0 0"))
    com[rng.integers(3)] += small(rng)
    write(origin, "xyz", com)
    return link.get("name")


def turned_inertia(root: Element, rng: Rng) -> str | None:
    link = pick(rng, heavy(root))
    if link is None:
        return None
    origin = child(link.find("inertial"), "origin")
    rpy = numbers(origin, "rpy", "0 0 0")
    write(origin, "rpy", [0.0] * 3 if any(rpy) and rng.random() < 0.5 else [rpy[0] + 1.0, 0.5, 0.0])
    return link.get("name")


def inertia_about_link_origin(root: Element, rng: Rng) -> str | None:
    link = pick(rng, heavy(root))
    if link is None:
        return None
    inertial = link.find("inertial")
    made, mass = child(inertial, "inertia"), float(inertial.find("mass").get("value"))
    x, y, z = numbers(inertial.find("origin"), "xyz", "0 0 0")
    added = {"ixx": y * y + z * z, "iyy": x * x + z * z, "izz": x * x + y * y}
    for key, value in added.items():
        write(made, key, float(made.get(key, "0")) + mass * value)
    return link.get("name")


def swapped_inertia(root: Element, rng: Rng) -> str | None:
    link = pick(rng, [link for link in heavy(root) if link.find("inertial/inertia") is not None])
    if link is None:
        return None
    made = link.find("inertial/inertia")
    one, two = pick(rng, [("ixx", "iyy"), ("iyy", "izz"), ("ixx", "izz")])
    first, second = made.get(one, "0"), made.get(two, "0")
    made.set(one, second)
    made.set(two, first)
    return link.get("name")


def scaled_mass(root: Element, rng: Rng) -> str | None:
    link = pick(rng, heavy(root))
    if link is None:
        return None
    mass = link.find("inertial/mass")
    write(mass, "value", float(mass.get("value")) * (1.0 + small(rng)))
    return link.get("name")


def scaled_inertia(root: Element, rng: Rng) -> str | None:
    link = pick(rng, [link for link in heavy(root) if link.find("inertial/inertia") is not None])
    if link is None:
        return None
    factor = 1.0 + small(rng)
    made = link.find("inertial/inertia")
    for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
        write(made, key, factor * float(made.get(key, "0")))
    return link.get("name")


def lost_body(root: Element, rng: Rng) -> str | None:
    link = pick(rng, heavy(root))
    if link is None:
        return None
    link.remove(link.find("inertial"))
    return link.get("name")


def _mimics(root: Element) -> list[Element]:
    return [joint for joint in moving(root) if joint.find("mimic") is not None]


def dropped_mimic(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, _mimics(root))
    if joint is None:
        return None
    joint.remove(joint.find("mimic"))
    return joint.get("name")


def flipped_mimic(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, _mimics(root))
    if joint is None:
        return None
    mimic = joint.find("mimic")
    write(mimic, "multiplier", -float(mimic.get("multiplier", "1")))
    return joint.get("name")


def shifted_mimic(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, _mimics(root))
    if joint is None:
        return None
    mimic = joint.find("mimic")
    write(mimic, "offset", float(mimic.get("offset", "0")) + small(rng))
    return joint.get("name")


def _limited(root: Element) -> list[Element]:
    return [
        joint
        for joint in joints(root, "revolute", "prismatic")
        if joint.find("limit") is not None and joint.find("limit").get("upper") is not None
    ]


def lost_limit(root: Element, rng: Rng) -> str | None:
    turning = [joint for joint in _limited(root) if joint.get("type") == "revolute"]
    joint = pick(rng, turning)
    if joint is None:
        return None
    joint.set("type", "continuous")
    return joint.get("name")


def shifted_limit(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, _limited(root))
    if joint is None:
        return None
    limit = joint.find("limit")
    end = pick(rng, ["lower", "upper"])
    outwards = abs(small(rng)) * (1.0 if end == "upper" else -1.0)
    write(limit, end, float(limit.get(end, "0")) + outwards)
    return joint.get("name")


def limit_in_degrees(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, [joint for joint in _limited(root) if joint.get("type") == "revolute"])
    if joint is None:
        return None
    limit = joint.find("limit")
    for end in ("lower", "upper"):
        write(limit, end, math.degrees(float(limit.get(end, "0"))))
    return joint.get("name")


def turned_limit(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, _limited(root))
    if joint is None:
        return None
    limit = joint.find("limit")
    lower, upper = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
    write(limit, "lower", -upper)
    write(limit, "upper", -lower)
    return joint.get("name")


def _lost(tag: str, key: str) -> Callable[[Element, Rng], str | None]:
    def lost(root: Element, rng: Rng) -> str | None:
        stated = [
            joint
            for joint in moving(root)
            if joint.find(tag) is not None
            and float(joint.find(tag).get(key, "0")) > 0
            and joint.find("mimic") is None
        ]
        joint = pick(rng, stated)
        if joint is None:
            return None
        joint.find(tag).set(key, "0")
        return joint.get("name")

    return lost


def wrong_offset(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, root.findall("joint"))
    if joint is None:
        return None
    origin = child(joint, "origin")
    position = np.array(numbers(origin, "xyz", "0 0 0"))
    position[rng.integers(3)] += small(rng)
    write(origin, "xyz", position)
    return joint.get("name")


def tilted_frame(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, root.findall("joint"))
    if joint is None:
        return None
    origin = child(joint, "origin")
    rpy = np.array(numbers(origin, "rpy", "0 0 0"))
    rpy[rng.integers(3)] += small(rng)
    write(origin, "rpy", rpy)
    return joint.get("name")


def reversed_rpy(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, root.findall("joint"))
    if joint is None:
        return None
    origin = child(joint, "origin")
    write(origin, "rpy", numbers(origin, "rpy", "0 0 0")[::-1])
    return joint.get("name")


def wrong_parent(root: Element, rng: Rng) -> str | None:
    carried = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
    hung = [joint for joint in root.findall("joint") if joint.find("parent").get("link") in carried]
    joint = pick(rng, hung)
    if joint is None:
        return None
    parent = joint.find("parent")
    above = carried[parent.get("link")].find("parent").get("link")
    parent.set("link", above)
    return joint.get("name")


def slide_for_hinge(root: Element, rng: Rng) -> str | None:
    joint = pick(rng, joints(root, "revolute", "prismatic"))
    if joint is None or joint.find("mimic") is not None:
        return None
    joint.set("type", "prismatic" if joint.get("type") == "revolute" else "revolute")
    return joint.get("name")


def held_joint(root: Element, rng: Rng) -> str | None:
    leaders = {mimic.get("joint") for mimic in root.findall("joint/mimic")}
    free = [joint for joint in moving(root) if joint.get("name") not in leaders]
    joint = pick(rng, free)
    if joint is None:
        return None
    joint.set("type", "fixed")
    return joint.get("name")


FAULTS: Mapping[str, tuple[Callable[[Element, Rng], str | None], str | None]] = {
    # kind -> edit, and the property that a form must represent to show it
    "sign flip": (sign_flip, None),
    "swapped axis": (swapped_axis, None),
    "millimetres: offset": (millimetre_offset, None),
    "millimetres: shape": (millimetre_shape, "shapes"),
    "shifted inertia": (shifted_inertia, None),
    "turned inertia": (turned_inertia, None),
    "inertia about link origin": (inertia_about_link_origin, None),
    "swapped inertia": (swapped_inertia, None),
    "scaled inertia": (scaled_inertia, None),
    "scaled mass": (scaled_mass, None),
    "lost body": (lost_body, None),
    "dropped mimic": (dropped_mimic, "mimic"),
    "flipped mimic": (flipped_mimic, "mimic"),
    "shifted mimic": (shifted_mimic, "mimic"),
    "lost limit": (lost_limit, "range"),
    "shifted limit": (shifted_limit, "range"),
    "limit in degrees": (limit_in_degrees, "range"),
    "turned limit": (turned_limit, "range"),
    "lost effort": (_lost("limit", "effort"), "effort"),
    "lost velocity": (_lost("limit", "velocity"), "velocity"),
    "lost damping": (_lost("dynamics", "damping"), "damping"),
    "lost friction": (_lost("dynamics", "friction"), "friction"),
    "wrong offset": (wrong_offset, None),
    "tilted frame": (tilted_frame, None),
    "reversed roll, pitch, yaw": (reversed_rpy, None),
    "wrong parent": (wrong_parent, None),
    "slide for hinge": (slide_for_hinge, None),
    "held joint": (held_joint, None),
}


# -- size of a fault, measured by Pinocchio on the two texts


def effect(right: Element, wrong: Element, target: str, rng: Rng) -> float:
    """Largest difference by the fault, in stated tolerances; infinite for a lost element."""
    bounds = Tolerances()
    loose = bounds.single if target == "USD" else 1.0
    found = [*_stated(right, wrong, target, bounds)]
    one, two = (_Rigid(root) for root in (right, wrong))
    if one.joints != two.joints or set(one.frames) != set(two.frames):
        return math.inf
    found.append(abs(one.mass - two.mass) / (bounds.mass * max(one.mass, 1e-12) + 1e-9))
    for _ in range(MEASURED):
        q = {name: one.draw(name, rng) for name in one.joints}
        a, b = one.at(q), two.at(q)
        for frame in one.frames:
            delta = a.frames[frame].actInv(b.frames[frame])
            apart = np.linalg.norm(a.frames[frame].translation - b.frames[frame].translation)
            found.append(float(apart) / bounds.position)
            found.append(float(np.linalg.norm(pin.log3(delta.rotation))) / bounds.orientation)
        found.append(float(np.linalg.norm(a.com - b.com)) / bounds.position)
        scale = np.sqrt(np.outer(np.diag(a.matrix), np.diag(a.matrix)))
        apart = np.abs(a.matrix - b.matrix) / (bounds.mass_matrix * scale + 1e-11)
        found.append(float(apart.max(initial=0.0)))
        most = 9.81 * np.sqrt(np.diag(a.matrix) * a.carried)
        apart = np.abs(a.gravity - b.gravity) / (bounds.gravity_torque * most + 1e-9)
        found.append(float(apart.max(initial=0.0)))
    return max(found) / loose


@dataclass(frozen=True, slots=True)
class _State:
    frames: Mapping[str, Any]
    com: Any
    matrix: Any
    gravity: Any
    carried: Any


class _Rigid:
    """Load a URDF in Pinocchio, without shapes."""

    def __init__(self, root: Element) -> None:
        bare = copy.deepcopy(root)
        for link in bare.findall("link"):
            for shape in (*link.findall("visual"), *link.findall("collision")):
                link.remove(shape)
        for joint in bare.findall("joint"):
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
        self.model = pin.buildModelFromXML(etree.tostring(bare, encoding="unicode"))
        self.data = self.model.createData()
        self.joints = {
            name: self.model.joints[self.model.getJointId(name)].shortname()[:13]
            for name in list(self.model.names)[1:]
            if self.model.joints[self.model.getJointId(name)].nv == 1
        }
        self.frames = {
            frame.name: i
            for i, frame in enumerate(self.model.frames)
            if frame.type == pin.FrameType.BODY
        }
        self.mass = float(sum(inertia.mass for inertia in self.model.inertias))

    def _joint(self, name: str) -> Any:
        return self.model.joints[self.model.getJointId(name)]

    def draw(self, name: str, rng: Rng) -> float:
        joint = self._joint(name)
        lower, upper = -math.pi, math.pi
        if joint.nq == 1:
            lower = max(lower, float(self.model.lowerPositionLimit[joint.idx_q]))
            upper = min(upper, float(self.model.upperPositionLimit[joint.idx_q]))
        return float(rng.uniform(min(lower, upper), max(lower, upper)))

    def at(self, q: Mapping[str, float]) -> _State:
        model, data = self.model, self.data
        full = pin.neutral(model)
        for name, value in q.items():
            joint = self._joint(name)
            wide = joint.nq == 2
            full[joint.idx_q : joint.idx_q + joint.nq] = (
                [math.cos(value), math.sin(value)] if wide else [value]
            )
        pin.framesForwardKinematics(model, data, full)
        frames = {name: pin.SE3(data.oMf[i]) for name, i in self.frames.items()}
        moment = sum(
            (inertia.mass * place.act(inertia.lever))
            for place, inertia in zip(data.oMi, model.inertias, strict=True)
        )
        matrix = np.array(pin.crba(model, data, full))
        matrix = np.triu(matrix) + np.triu(matrix, 1).T
        gravity = np.array(pin.computeGeneralizedGravity(model, data, full))
        pin.computeSubtreeMasses(model, data)
        index = [self._joint(name).idx_v for name in self.joints]
        carried = np.array([data.mass[model.getJointId(name)] for name in self.joints])
        com = moment / self.mass if self.mass > 0 else np.zeros(3)
        return _State(frames, com, matrix[np.ix_(index, index)], gravity[index], carried)


def _stated(right: Element, wrong: Element, target: str, bounds: Tolerances) -> Iterator[float]:
    """Differences of the values in the texts, in tolerances."""
    carries = CARRIES[target]
    for one, two in zip(right.findall("joint"), wrong.findall("joint"), strict=True):
        if one.get("type") != two.get("type") and "range" in carries:
            yield math.inf
        for fact, tag, key in (
            ("range", "limit", "lower"),
            ("range", "limit", "upper"),
            ("velocity", "limit", "velocity"),
            ("effort", "limit", "effort"),
            ("damping", "dynamics", "damping"),
            ("friction", "dynamics", "friction"),
            ("mimic", "mimic", "multiplier"),
            ("mimic", "mimic", "offset"),
        ):
            if fact not in carries:
                continue
            a, b = one.find(tag), two.find(tag)
            if (a is None) != (b is None):
                yield math.inf
            elif a is not None:
                standard = "1" if key == "multiplier" else "0"
                before, after = float(a.get(key, standard)), float(b.get(key, standard))
                if min(abs(before), abs(after)) > ENDLESS:
                    continue
                yield abs(before - after) / (bounds.limit * max(1.0, abs(before)))
    for one, two in zip(right.findall("link"), wrong.findall("link"), strict=True):
        if "links" in carries:
            yield from _link_stated(one, two, bounds)
        if "shapes" in carries:
            shapes = (link.findall("collision/geometry/*") for link in (one, two))
            for a, b in zip(*shapes, strict=True):
                for key in ("size", "radius", "length", "scale"):
                    before, after = (numbers(shape, key, "1 1 1") for shape in (a, b))
                    apart = max(abs(x - y) for x, y in zip(before, after, strict=True))
                    if apart:
                        reach = _reach(a)
                        yield apart * reach / (bounds.shape * max(1.0, reach))


def _reach(shape: Element) -> float:
    """Change of a shape's bounding box per unit of its size or scale, m."""
    return 0.02 if shape.tag == "mesh" else 0.5


def _link_stated(one: Element, two: Element, bounds: Tolerances) -> Iterator[float]:
    a, b = one.find("inertial"), two.find("inertial")
    if a is None or b is None:
        if a is not None and float(a.find("mass").get("value")) > 1e-9:
            yield math.inf
        return
    masses = [float(inertial.find("mass").get("value")) for inertial in (a, b)]
    yield abs(masses[0] - masses[1]) / (bounds.mass * masses[0] + 1e-9)
    if masses[0] <= 1e-9:
        return
    coms = [np.array(numbers(i.find("origin"), "xyz", "0 0 0")) for i in (a, b)]
    yield float(np.linalg.norm(coms[0] - coms[1])) / bounds.position
    tensors = [_tensor(inertial) for inertial in (a, b)]
    most = bounds.inertia * np.abs(tensors[0]).max() + 1e-11
    yield float(np.abs(tensors[0] - tensors[1]).max()) / most


def _tensor(inertial: Element) -> Any:
    made = inertial.find("inertia")
    if made is None:
        return np.zeros((3, 3))
    xx, yy, zz, xy, xz, yz = (
        float(made.get(key, "0")) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    axes = pin.rpy.rpyToMatrix(np.array(numbers(inertial.find("origin"), "rpy", "0 0 0")))
    return axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T


# -- robots


@dataclass
class Subject:
    """A robot without faults, in every form."""

    name: str
    urdf: Path
    forms: dict[str, Form]
    configurations: list[dict[str, float]]
    alarms: dict[Key, str] = field(default_factory=dict)


def random_robots(count: int, start: int) -> list[Any]:
    found: list[Any] = []

    @seed(start)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(robots(links=(3, 8)))
    def collect(robot: Any) -> None:
        found.append(robot)

    while len(found) < count:
        collect()
    return found[:count]


def drawn_configurations(model: Any, start: int) -> list[dict[str, float]]:
    found: list[dict[str, float]] = []

    @seed(start)
    @settings(
        max_examples=4 * DRAWN,
        deadline=None,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(configurations(model))
    def collect(q: dict[str, float]) -> None:
        found.append(q)

    collect()
    return found[-DRAWN:]


def real_robots() -> list[Path]:
    """The URDFs of example-robot-data."""
    try:
        files = distribution("example-robot-data").files or []
    except PackageNotFoundError:
        return []
    paths = [Path(str(file.locate())) for file in files if str(file).endswith(".urdf")]
    return sorted(path for path in paths if path.is_file())


def normalized(path: Path, folder: Path) -> Path:
    """Copy the robot to its own folder, with repairs accepted and visual shapes removed."""
    made = normalize(path, folder)
    patches = [flag.patch for flag in made.flags if flag.patch]
    if patches:
        made = normalize(path, folder, accept=patches)
    tree = etree.parse(str(made.urdf))
    for link in tree.getroot().findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is not None:
                file = made.urdf.parent / mesh.get("filename")
                if file.stat().st_size > HEAVY:
                    link.remove(collision)
    tree.write(str(made.urdf))
    return made.urdf


def subject(name: str, urdf: Path, start: int) -> Subject:
    forms = {"text": text_form(urdf)}
    for target, (build, _) in TARGETS.items():
        try:
            forms[target] = build(urdf)
        except usd.UsdMissingError:
            continue
    asset = Asset(name, list(forms.values()))
    drawn = drawn_configurations(asset.simulated[0].model, start)
    made = Subject(name, urdf, forms, [asset.generic, *drawn])
    for broken, key in _broken(asset, made.configurations):
        made.alarms.setdefault(key, str(broken))
    return made


def _broken(
    asset: Asset, qs: list[dict[str, float]], known: Mapping[Key, str] | None = None
) -> Iterator[tuple[Broken, Key]]:
    for name, made in PROPERTIES.items():
        for q in qs if made.needs_poses else [None]:
            for broken in made.check(asset) if q is None else made.check(asset, q):
                key = (name, broken.element, broken.what, broken.forms)
                if known is None or key not in known:
                    yield broken, key


# -- the run


@dataclass
class Tally:
    """Result of one mutation."""

    caught: Counter[str] = field(default_factory=Counter)
    above: Counter[str] = field(default_factory=Counter)
    below: Counter[str] = field(default_factory=Counter)
    below_caught: Counter[str] = field(default_factory=Counter)
    by_property: Counter[str] = field(default_factory=Counter)
    targets: Counter[str] = field(default_factory=Counter)
    sources: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    missed: list[str] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    robots: int = 0

    @property
    def mutations(self) -> int:
        return self.above.total() + self.below.total()


def mutate(subject: Subject, source: str, rng: Rng, tally: Tally) -> None:
    """One fault in one realization of a robot."""
    targets = [target for target in TARGETS if target in subject.forms]
    weights = np.array([TARGETS[target][1] for target in targets])
    right = etree.parse(str(subject.urdf)).getroot()
    for _ in range(50):
        kind = pick(rng, list(FAULTS))
        edit, needs = FAULTS[kind]
        target = str(rng.choice(targets, p=weights / weights.sum()))
        if needs is not None and needs not in CARRIES[target]:
            continue
        wrong = copy.deepcopy(right)
        element = edit(wrong, rng)
        if element is not None:
            break
    else:
        return
    size = effect(right, wrong, target, rng)
    path = subject.urdf.with_name("faulty.urdf")
    path.write_bytes(etree.tostring(wrong))
    by = _catcher(subject, target, path)
    tally.targets[target] += 1
    row = tally.above if size > 1.0 else tally.below
    row[kind] += 1
    if size > 1.0:
        tally.sources[source]["above"] += 1
    if by is None:
        if size > 1.0:
            words = f"{kind} at '{element}' of {subject.name} in {target}: {size:.3g} tolerances"
            tally.missed.append(words)
        return
    if size > 1.0:
        tally.caught[kind] += 1
        tally.sources[source]["caught"] += 1
        tally.by_property[by] += 1
    else:
        tally.below_caught[kind] += 1


def _catcher(subject: Subject, target: str, path: Path) -> str | None:
    """Return the property that detects the fault, or the importer's refusal; None if undetected."""
    try:
        if b"scale=" in path.read_bytes():
            # Realizations are made from normalized assets, whose meshes are in metres.
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                made = normalize(path, Path(folder))
                faulty = TARGETS[target][0](made.urdf)
        else:
            faulty = TARGETS[target][0](path)
        forms = {**subject.forms, target: faulty}
        if target != "USD":
            forms.pop("USD", None)
        asset = Asset(subject.name, list(forms.values()))
        for _, key in _broken(asset, subject.configurations, subject.alarms):
            return key[0]
    except TwinError:
        return "refused by the importer"
    return None


def subjects(folder: Path, count: int, start: int, tally: Tally) -> Iterator[tuple[str, Subject]]:
    """Yield random and real robots in turn, endlessly."""
    real = real_robots()
    drawn = iter(random_robots(count // 2 + 1 if real else count, start))
    np.random.default_rng(start).shuffle(real)  # type: ignore[arg-type]
    for number in range(count):
        place = folder / str(number)
        place.mkdir()
        name = f"robot {number}"
        try:
            if number % 2 and real:
                path = real[number // 2 % len(real)]
                source, name = "real", path.stem
                urdf = normalized(path, place)
                if len(etree.parse(str(urdf)).findall("joint")) > MOST_JOINTS:
                    tally.skipped.append(f"{name}: more than {MOST_JOINTS} joints")
                    continue
            else:
                robot = next(drawn)
                source, name, urdf = "random", f"random robot {number}", robot.write(place)
            made = subject(name, urdf, start + number)
        except TwinError as error:
            tally.skipped.append(f"{name}: {error}")
            continue
        tally.robots += 1
        tally.alarms += [f"{name}: {key[0]}: {words}" for key, words in made.alarms.items()]
        yield source, made


def run(mutations: int, start: int, *, say: Callable[[str], None] = lambda words: None) -> Tally:
    """``mutations`` faults, ``PER_ROBOT`` on each robot."""
    tally = Tally()
    rng = np.random.default_rng(start)
    with tempfile.TemporaryDirectory() as folder:
        count = 2 * math.ceil(mutations / PER_ROBOT) + 4
        for source, made in subjects(Path(folder), count, start, tally):
            for _ in range(min(PER_ROBOT, mutations - tally.mutations)):
                mutate(made, source, rng, tally)
            say(f"\r{tally.mutations}/{mutations} mutations, {len(tally.missed)} missed")
            if tally.mutations >= mutations:
                break
    return tally


def main() -> int:
    """Run and report; return 1 if a fault beyond tolerance was missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the numbers here too")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    begin = time.perf_counter()

    def say(words: str) -> None:
        if sys.stderr.isatty():
            print(words, end="", file=sys.stderr, flush=True)

    tally = run(arguments.mutations, arguments.seed, say=say)
    above, caught = tally.above.total(), tally.caught.total()
    print(f"{tally.mutations} mutations on {tally.robots} robots, seed {arguments.seed}")
    print(f"injected into: {dict(tally.targets)}")
    print(f"effect beyond the stated tolerance: {above}, caught {caught} ({caught / above:.2%})")
    for source, counts in tally.sources.items():
        print(f"  {source} robots: {counts['caught']} of {counts['above']}")
    print(f"effect within tolerance: {tally.below.total()}", end="")
    print(f" ({tally.below_caught.total()} of them seen all the same)")
    print("| fault | beyond tolerance | caught | within tolerance |")
    print("|---|---|---|---|")
    for kind in FAULTS:
        row = tally.above[kind], tally.caught[kind], tally.below[kind]
        print(f"| {kind} | " + " | ".join(map(str, row)) + " |")
    print("first seen by: ", dict(tally.by_property.most_common()))
    for words in tally.missed:
        print(f"missed: {words}")
    for words in tally.alarms:
        print(f"alarm on a robot without a fault: {words}")
    for words in tally.skipped:
        print(f"left out: {words}")
    print(f"{time.perf_counter() - begin:.0f} s")
    if arguments.json is not None:
        numbers_out = {
            "mutations": tally.mutations,
            "above": dict(tally.above),
            "caught": dict(tally.caught),
            "within": dict(tally.below),
            "missed": tally.missed,
        }
        arguments.json.write_text(json.dumps(numbers_out, indent=1) + "\n")
    return 1 if tally.missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
