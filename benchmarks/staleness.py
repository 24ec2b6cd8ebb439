"""Search for stale goldens that the dependency map misses, with random models and edits.

    python benchmarks/staleness.py --edits 2000 --seed 1

The script draws robots with several kinematic trees, records goldens of many kinds on them, makes
one random edit of the MJCF, and runs the goldens again. A golden whose result leaves its tolerance
although the dependency map calls it fresh is a miss. The share of goldens that are called stale
without a change is printed too; it is the cost of missing none.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from pytest_twin.checks import check_of
from pytest_twin.checks.base import NothingToProposeError, Trace
from pytest_twin.errors import TwinError
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure
from pytest_twin.realization import Realization, load
from pytest_twin.realization.collision import disabled_pairs
from pytest_twin.staleness import Baseline, DependencyMap, Lookups, Model, dependency_map, staleness
from pytest_twin.twin import Twin, load_twin

EDITS_PER_MODEL = 8
Element = Any
Rng = np.random.Generator


# -- random robots


def numbers(*values: float) -> str:
    return " ".join(f"{value:.5g}" for value in values)


def unit_vector(rng: Rng) -> str:
    vector = rng.normal(size=3)
    return numbers(*(vector / np.linalg.norm(vector)))


class Robot:
    """Return a random MJCF: several trees over a floor, with MJCF's couplings between them."""

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        self.bodies: list[str] = []
        self.hinges: list[str] = []
        self.joints: list[str] = []
        self.geoms: list[str] = []
        self.sites: list[str] = []
        self.meshes: list[str] = []
        self.root = etree.Element("mujoco", model="random")
        self._head()
        world = etree.SubElement(self.root, "worldbody")
        if rng.random() < 0.6:
            etree.SubElement(world, "geom", name="floor", type="plane", size="2 2 0.1")
            self.geoms.append("floor")
        etree.SubElement(world, "light", pos="0 0 3")
        for tree in range(int(rng.integers(1, 4))):
            self._tree(world, tree)
        self._contact()
        self._ties()
        self._actuators()
        self._sensors()

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def pick(self, items: list[Any]) -> Any:
        return items[int(self.rng.integers(len(items)))]

    def _head(self) -> None:
        rng = self.rng
        etree.SubElement(
            self.root, "compiler", angle="radian", autolimits="true", inertiafromgeom="auto"
        )
        option = etree.SubElement(
            self.root,
            "option",
            timestep=self.pick(["0.001", "0.002"]),
            integrator=self.pick(["Euler", "implicitfast", "RK4"]),
            gravity="0 0 -9.81",
        )
        if self.chance(0.2):
            option.set("density", "1.2")
            option.set("viscosity", "0.01")
        default = etree.SubElement(self.root, "default")
        etree.SubElement(default, "joint", damping=numbers(rng.uniform(0.2, 1)), armature="0.02")
        etree.SubElement(default, "geom", friction="0.8 0.005 0.0001", density="500")
        seen = etree.SubElement(default, "default", {"class": "seen"})
        etree.SubElement(seen, "geom", contype="0", conaffinity="0", rgba="0.5 0.5 0.5 1")
        asset = etree.SubElement(self.root, "asset")
        etree.SubElement(asset, "material", name="paint", rgba="0.1 0.2 0.3 1")
        for i in range(int(rng.integers(0, 3))):
            points = rng.uniform(-0.05, 0.05, size=(int(rng.integers(5, 9)), 3))
            vertices = " ".join(numbers(*point) for point in points)
            etree.SubElement(asset, "mesh", name=f"mesh{i}", vertex=vertices)
            self.meshes.append(f"mesh{i}")

    def _tree(self, world: Element, tree: int) -> None:
        rng = self.rng
        base = etree.SubElement(
            world,
            "body",
            name=f"base{tree}",
            pos=numbers(0.6 * tree, rng.uniform(-0.1, 0.1), rng.uniform(0.2, 0.5)),
        )
        masks = [("1", "1"), ("2", "2"), ("0", "0"), ("1", "3")][int(rng.integers(4))]
        if self.chance(0.2):
            etree.SubElement(base, "freejoint", name=f"free{tree}")
            self.joints.append(f"free{tree}")
        self._body(base, f"{tree}", masks)
        parents = [base]
        for i in range(int(rng.integers(1, 5))):
            parent = self.pick(parents)
            body = etree.SubElement(
                parent,
                "body",
                name=f"link{tree}_{i}",
                pos=numbers(rng.uniform(-0.05, 0.05), 0, rng.uniform(0.1, 0.25)),
            )
            if self.chance(0.3):
                body.set("quat", numbers(1, *rng.uniform(-0.3, 0.3, size=3)))
            if self.chance(0.15):
                body.set("gravcomp", numbers(rng.uniform(0, 1)))
            if self.chance(0.85):
                self._joint(body, f"joint{tree}_{i}")
            self._body(body, f"{tree}_{i}", masks)
            parents.append(body)

    def _joint(self, body: Element, name: str) -> None:
        rng = self.rng
        kind = self.pick(["hinge", "hinge", "hinge", "slide", "ball"])
        joint = etree.SubElement(body, "joint", name=name, type=kind)
        if kind == "ball":
            self.joints.append(name)
            return
        joint.set("axis", unit_vector(rng))
        if self.chance(0.8):
            reach = 0.1 if kind == "slide" else 1.5
            joint.set("range", numbers(-rng.uniform(0.3, 1) * reach, rng.uniform(0.3, 1) * reach))
        if self.chance(0.3):
            joint.set("stiffness", numbers(rng.uniform(0.1, 5)))
            joint.set("springref", numbers(rng.uniform(-0.05, 0.05)))
        if self.chance(0.3):
            joint.set("frictionloss", numbers(rng.uniform(0.01, 0.2)))
        self.joints.append(name)
        self.hinges.append(name)

    def _body(self, body: Element, name: str, masks: tuple[str, str]) -> None:
        rng = self.rng
        if self.chance(0.4):
            a, b = rng.uniform(0.002, 0.005, size=2)
            etree.SubElement(
                body,
                "inertial",
                pos=numbers(*rng.uniform(-0.03, 0.03, size=3)),
                mass=numbers(rng.uniform(0.2, 2)),
                diaginertia=numbers(a, b, rng.uniform(abs(a - b) + 1e-4, a + b)),
            )
        for i in range(int(rng.integers(1, 3))):
            geom = etree.SubElement(
                body, "geom", name=f"geom{name}_{i}", contype=masks[0], conaffinity=masks[1]
            )
            kind = self.pick(["box", "sphere", "capsule", "cylinder", "mesh"])
            if kind == "mesh" and self.meshes:
                geom.set("type", "mesh")
                geom.set("mesh", self.pick(self.meshes))
            else:
                count = {"sphere": 1, "box": 3}.get(kind, 2)
                geom.set("type", kind if kind != "mesh" else "sphere")
                geom.set(
                    "size", numbers(*rng.uniform(0.02, 0.05, size=1 if kind == "mesh" else count))
                )
            geom.set("pos", numbers(*rng.uniform(-0.04, 0.04, size=3)))
            self.geoms.append(f"geom{name}_{i}")
        if self.chance(0.4):
            etree.SubElement(
                body,
                "geom",
                {"class": "seen"},
                size="0.03",
                pos="0 0.02 0",
                mass="0",
                material="paint",
            )
        if self.chance(0.7):
            etree.SubElement(
                body, "site", name=f"site{name}", pos=numbers(*rng.uniform(-0.1, 0.1, size=3))
            )
            self.sites.append(f"site{name}")
        self.bodies.append(body.get("name"))

    def _contact(self) -> None:
        contact = etree.SubElement(self.root, "contact")
        if self.chance(0.4) and len(self.bodies) > 1:
            a, b = self.rng.choice(self.bodies, size=2, replace=False)
            etree.SubElement(contact, "exclude", body1=str(a), body2=str(b))
        if self.chance(0.15) and len(self.geoms) > 1:
            a, b = self.rng.choice(self.geoms, size=2, replace=False)
            etree.SubElement(contact, "pair", geom1=str(a), geom2=str(b), margin="0.01")

    def _ties(self) -> None:
        equality = etree.SubElement(self.root, "equality")
        tendon = etree.SubElement(self.root, "tendon")
        if self.chance(0.3) and len(self.hinges) > 1:
            a, b = self.rng.choice(self.hinges, size=2, replace=False)
            etree.SubElement(
                equality,
                "joint",
                name="mimic",
                joint1=str(a),
                joint2=str(b),
                polycoef="0 0.5 0 0 0",
            )
        if self.chance(0.15) and len(self.bodies) > 1:
            a, b = self.rng.choice(self.bodies, size=2, replace=False)
            kind = self.pick(["connect", "weld"])
            tie = etree.SubElement(equality, kind, name="tie", body1=str(a), body2=str(b))
            if kind == "connect":
                tie.set("anchor", "0 0 0.02")
        if self.chance(0.25) and len(self.hinges) > 1:
            a, b = self.rng.choice(self.hinges, size=2, replace=False)
            fixed = etree.SubElement(tendon, "fixed", name="mix", stiffness="1", damping="0.1")
            etree.SubElement(fixed, "joint", joint=str(a), coef="1")
            etree.SubElement(fixed, "joint", joint=str(b), coef="-0.5")
        if self.chance(0.25) and len(self.sites) > 1:
            a, b = self.rng.choice(self.sites, size=2, replace=False)
            cable = etree.SubElement(tendon, "spatial", name="cable", stiffness="3", damping="0.2")
            etree.SubElement(cable, "site", site=str(a))
            etree.SubElement(cable, "site", site=str(b))

    def _actuators(self) -> None:
        actuator = etree.SubElement(self.root, "actuator")
        for joint in self.hinges:
            kind = self.pick(["position", "position", "motor", "velocity", "none"])
            if kind == "none":
                continue
            servo = etree.SubElement(actuator, kind, name=f"act_{joint}", joint=joint)
            if kind == "position":
                servo.set("kp", numbers(self.rng.uniform(5, 40)))
                servo.set("kv", numbers(self.rng.uniform(0.5, 3)))
            if kind == "velocity":
                servo.set("kv", "2")
            if self.chance(0.4):
                servo.set("forcerange", "-6 6")
        if self.sites and self.chance(0.15):
            etree.SubElement(
                actuator, "general", name="thrust", site=self.pick(self.sites), gear="0 0 1 0 0 0"
            )

    def _sensors(self) -> None:
        sensor = etree.SubElement(self.root, "sensor")
        if self.sites:
            etree.SubElement(sensor, "framepos", objtype="site", objname=self.pick(self.sites))

    @property
    def text(self) -> str:
        return str(etree.tostring(self.root, pretty_print=True, encoding="unicode"))


# -- goldens on them


def proposed(kind: str, realization: Realization) -> Sequence[Mapping[str, Any]]:
    """Return the first goldens of a kind; none if the robot does not support it."""
    try:
        return check_of(kind).first(realization)
    except NothingToProposeError:
        return []


def specs(realization: Realization, rng: Rng) -> Iterator[dict[str, Any]]:
    """Return goldens of the kinds that need only a model, with realistic tolerances."""
    structure = realization.structure
    scalar = [j for j, kind in structure.joint_type.items() if kind in ("hinge", "slide")]
    frames = [f for f in structure.frame_body if f != "world"]
    driven = {j for joints in structure.actuator_joints.values() for j in joints}
    poses: list[Any] = ["reference", {"seed": int(rng.integers(1000)), "count": 3}]
    for frame in rng.permutation(frames)[:3]:
        yield {
            "kind": "fk",
            "target": {"frames": [str(frame)]},
            "stimulus": {"poses": poses},
            "tolerance": {"position": "1 um", "orientation": "1e-6 rad"},
        }
    yield {
        "kind": "mass_properties",
        "stimulus": {"poses": poses},
        "tolerance": {
            "mass": "1e-6 kg",
            "center_of_mass": "1 um",
            "gravity_torque": "1e-6 N*m",
            "gravity_force": "1e-6 N",
        },
    }
    yield {
        "kind": "settling",
        "stimulus": {"duration": "300 ms"},
        "tolerance": {"angle": "1e-5 rad", "position": "1e-5 m"},
    }
    for kind in ("joint_direction", "limits", "contact"):
        for spec in proposed(kind, realization):
            units = check_of(kind).tolerances
            tight = {
                name: "1e-3 %" if units[name] == "1" else f"1e-5 {units[name]}"
                for name in spec["tolerance"]
            }
            stimulus = {**spec.get("stimulus", {}), "duration": "100 ms"}
            yield {
                "kind": kind,
                "target": spec["target"],
                "stimulus": stimulus,
                "tolerance": {**tight, **({"direction": "1 deg"} if "direction" in tight else {})},
            }
    for joint in map(str, rng.permutation([j for j in scalar if j in driven])[:3]):
        hinge = structure.joint_type[joint] == "hinge"
        angle, rate, effort = ("rad", "rad/s", "N*m") if hinge else ("m", "m/s", "N")
        moves = ("angle", "angular_velocity") if hinge else ("position", "linear_velocity")
        # One of them is the command mode of its actuator.
        for amplitude, name, unit in (
            (f"0.02 {angle}", moves[0], angle),
            (f"0.1 {rate}", moves[1], rate),
            (f"0.1 {effort}", moves[1], rate),
        ):
            yield {
                "kind": "step",
                "target": {"joint": joint},
                "stimulus": {"amplitude": amplitude, "duration": "200 ms", "settle": "50 ms"},
                "tolerance": {name: f"1e-5 {unit}"},
            }
            yield {
                "kind": "frequency_response",
                "target": {"joint": joint},
                "stimulus": {
                    "amplitude": amplitude,
                    "band": ["10 Hz", "50 Hz"],
                    "period": "100 ms",
                    "lines": 3,
                    "realizations": 2,
                    "settle": "50 ms",
                },
                "tolerance": {"magnitude": "1e-4 dB"},
            }
    bodies = sorted(structure.collision_bodies)
    pairs = [[a, b] for i, a in enumerate(bodies) for b in bodies[i + 1 :]]
    disabled = [
        {"pair": list(pair), "reason": "drawn so"} for pair, _ in disabled_pairs(realization)
    ]
    for i in rng.permutation(len(pairs))[:2]:
        yield {
            "kind": "collision_distance",
            "target": {"pairs": [pairs[i]], "disabled": disabled},
            "stimulus": {"poses": poses},
            "tolerance": {"distance": "10 um", "penetration": "10 um"},
        }


# -- edits

ADDED: dict[str, dict[str, list[str]]] = {
    "option": {
        "gravity": ["0 0 -9.7", "0.1 0 -9.81"],
        "wind": ["1 0 0"],
        "density": ["1.3"],
        "viscosity": ["0.02"],
        "timestep": ["0.0015"],
        "integrator": ["Euler", "implicit"],
        "solver": ["PGS", "CG"],
        "iterations": ["3"],
        "cone": ["elliptic"],
        "impratio": ["3"],
        "magnetic": ["1 0 0"],
        "noslip_iterations": ["3"],
    },
    "compiler": {
        "boundmass": ["0.3"],
        "boundinertia": ["0.01"],
        "settotalmass": ["5"],
        "autolimits": ["false"],
        "angle": ["degree"],
        "inertiafromgeom": ["true", "auto"],
        "fusestatic": ["true"],
    },
    "body": {
        "gravcomp": ["0.5", "1"],
        "quat": ["0.9 0.1 0 0"],
        "pos": ["0.01 0.02 0.2"],
        "euler": ["0.1 0 0"],
        "mocap": ["true"],
    },
    "joint": {
        "damping": ["0.9", "0.5 0.1"],
        "armature": ["0.05"],
        "frictionloss": ["0.3"],
        "stiffness": ["2", "1 0.5"],
        "springref": ["0.1"],
        "ref": ["0.05"],
        "range": ["-0.02 0.02", "-0.7 0.7"],
        "margin": ["0.05"],
        "solreflimit": ["0.1 1"],
        "solimpfriction": ["0.5 0.6 0.01"],
        "actuatorfrcrange": ["-0.2 0.2"],
        "axis": ["0 1 0"],
        "pos": ["0 0.02 0"],
        "group": ["3"],
    },
    "geom": {
        "rgba": ["1 0 0 1"],
        "group": ["2"],
        "contype": ["0", "1", "2"],
        "conaffinity": ["0", "1", "2"],
        "condim": ["1", "4", "6"],
        "friction": ["0.1 0.001 0.0001"],
        "priority": ["1"],
        "margin": ["0.02"],
        "gap": ["0.01"],
        "solref": ["0.05 1"],
        "solimp": ["0.5 0.8 0.01"],
        "solmix": ["5"],
        "pos": ["0 0 0.06"],
        "quat": ["0.8 0.2 0 0"],
        "density": ["800"],
        "mass": ["0.7"],
        "fluidshape": ["ellipsoid"],
        "size": ["0.04 0.03 0.02"],
        "material": ["paint"],
    },
    "site": {"pos": ["0.02 0 0.1"], "quat": ["0.9 0 0.1 0"], "rgba": ["0 1 0 1"], "size": ["0.02"]},
    "position": {
        "kp": ["33"],
        "kv": ["0.4"],
        "gear": ["1.5"],
        "ctrlrange": ["-0.01 0.01"],
        "forcerange": ["-0.1 0.1"],
        "timeconst": ["0.05"],
        "group": ["1"],
    },
    "motor": {"gear": ["2"], "ctrlrange": ["-0.05 0.05"], "forcerange": ["-0.01 0.01"]},
    "velocity": {"kv": ["1"], "ctrlrange": ["-0.1 0.1"], "gear": ["2"]},
    "weld": {"solref": ["0.1 1"], "active": ["false"]},
    "connect": {"solref": ["0.1 1"], "active": ["false"], "anchor": ["0 0.01 0"]},
    "exclude": {"name": ["apart"]},
    "pair": {"condim": ["1"], "margin": ["0.05"], "gap": ["0.01"]},
    "fixed": {"damping": ["1"], "stiffness": ["3"], "range": ["-0.1 0.1"], "frictionloss": ["0.1"]},
    "spatial": {"damping": ["1"], "stiffness": ["9"], "springlength": ["0.1"], "width": ["0.01"]},
    "mesh": {"scale": ["1.1 1 1"], "inertia": ["shell", "convex"], "refpos": ["0.01 0 0"]},
    "light": {"pos": ["1 1 1"], "diffuse": ["1 0 0"]},
    "material": {"rgba": ["1 1 1 1"], "specular": ["0.9"]},
}

BODY_PARTS: dict[str, list[dict[str, str]]] = {
    "geom": [
        {"size": "0.03"},
        {"size": "0.02", "contype": "0", "conaffinity": "0", "mass": "0"},
        {"type": "box", "size": "0.1 0.1 0.01", "pos": "0 0 0.05", "mass": "0.1"},
    ],
    "site": [{"name": "added", "pos": "0 0 0.05"}],
    "camera": [{"name": "eye", "pos": "0 0 1"}],
    "light": [{"pos": "0 0 2"}],
    "joint": [{"name": "added", "type": "hinge", "axis": "1 0 0"}],
}


def all_elements(root: Element) -> list[Element]:
    return [e for e in root.iter() if isinstance(e.tag, str) and e is not root]


def change_number(root: Element, rng: Rng) -> str | None:
    """Change one number of one attribute, slightly or strongly."""
    places = []
    for element in all_elements(root):
        for key, value in element.attrib.items():
            words = value.split()
            try:
                [float(word) for word in words]
            except ValueError:
                continue
            if words:
                places.append((element, key, words))
    element, key, words = places[int(rng.integers(len(places)))]
    at = int(rng.integers(len(words)))
    old = float(words[at])
    scale = 10.0 ** rng.uniform(-3, 0)
    if old == int(old) and key in INTEGERS:
        new = old + int(rng.integers(1, 3))
    else:
        new = old + scale * rng.choice([-1, 1]) * max(abs(old), 0.02)
    words[at] = f"{new:.9g}"
    element.set(key, " ".join(words))
    return f"{element.tag} {key} {old:g} -> {new:g}"


INTEGERS = frozenset({"contype", "conaffinity", "condim", "priority", "group", "iterations"})


def add_attribute(root: Element, rng: Rng) -> str | None:
    """Set an attribute that had its default value, or change it."""
    elements = [e for e in all_elements(root) if e.tag in ADDED]
    element = elements[int(rng.integers(len(elements)))]
    keys = sorted(ADDED[element.tag])
    key = keys[int(rng.integers(len(keys)))]
    value = str(rng.choice(ADDED[element.tag][key]))
    element.set(key, value)
    return f"{element.tag} {key} = {value}"


def remove_attribute(root: Element, rng: Rng) -> str | None:
    """Remove an attribute, so that it gets its default value."""
    places = [(e, k) for e in all_elements(root) for k in e.attrib if k not in ("name", "class")]
    element, key = places[int(rng.integers(len(places)))]
    del element.attrib[key]
    return f"{element.tag} without {key}"


def add_element(root: Element, rng: Rng) -> str | None:
    """Add an element to a body."""
    bodies = [*root.iter("body"), root.find("worldbody")]
    body = bodies[int(rng.integers(len(bodies)))]
    tag = str(rng.choice(sorted(BODY_PARTS)))
    kinds = BODY_PARTS[tag]
    attributes = kinds[int(rng.integers(len(kinds)))]
    if rng.random() < 0.3:
        body = etree.SubElement(body, "body", name="added_body", pos="0 0.05 0.05")
        etree.SubElement(body, "geom", size="0.02")
        if tag == "geom":
            return "new body"
    body.insert(int(rng.integers(len(body) + 1)), etree.Element(tag, attributes))
    return f"new {tag} on {body.get('name', 'world')}"


def add_tie(root: Element, rng: Rng) -> str | None:
    """Add a coupling, actuator, contact exclusion or keyframe."""
    names = {
        tag: [str(e.get("name")) for e in root.iter(tag) if e.get("name")]
        for tag in ("body", "joint", "site", "geom")
    }

    def two(tag: str) -> list[str]:
        return [str(name) for name in rng.choice(names[tag], size=2, replace=False)]

    kind = str(
        rng.choice(["exclude", "pair", "mimic", "connect", "weld", "spring", "motor", "numeric"])
    )
    try:
        if kind == "exclude":
            a, b = two("body")
            etree.SubElement(root.find("contact"), "exclude", body1=a, body2=b)
        elif kind == "pair":
            a, b = two("geom")
            etree.SubElement(root.find("contact"), "pair", geom1=a, geom2=b)
        elif kind == "mimic":
            a, b = two("joint")
            etree.SubElement(root.find("equality"), "joint", joint1=a, joint2=b)
        elif kind in ("connect", "weld"):
            a, b = two("body")
            tie = etree.SubElement(root.find("equality"), kind, body1=a, body2=b)
            if kind == "connect":
                tie.set("anchor", "0 0 0")
        elif kind == "spring":
            a, b = two("site")
            cable = etree.SubElement(root.find("tendon"), "spatial", stiffness="5")
            etree.SubElement(cable, "site", site=a)
            etree.SubElement(cable, "site", site=b)
        elif kind == "motor":
            etree.SubElement(root.find("actuator"), "motor", joint=str(rng.choice(names["joint"])))
        else:
            custom = etree.SubElement(root, "custom")
            etree.SubElement(custom, "numeric", name="n", data="1 2")
    except ValueError:
        return None
    return f"new {kind}"


def remove_element(root: Element, rng: Rng) -> str | None:
    """Remove an element with its children and all references to it."""
    kept = {"worldbody", "default", "asset", "contact", "equality", "tendon", "actuator", "sensor"}
    elements = [e for e in all_elements(root) if e.tag not in kept]
    element = elements[int(rng.integers(len(elements)))]
    element.getparent().remove(element)
    return f"without {element.tag} {element.get('name', '')}"


def reorder(root: Element, rng: Rng) -> str | None:
    """Swap two neighbouring elements."""
    parents = [e for e in all_elements(root) if len(e) > 1]
    parent = parents[int(rng.integers(len(parents)))]
    at = int(rng.integers(len(parent) - 1))
    first = parent[at]
    parent.remove(first)
    parent.insert(at + 1, first)
    return f"reordered in {parent.get('name', parent.tag)}"


def only_seen(root: Element, rng: Rng) -> str | None:
    """Add a comment, colour or visual, without physical effect."""
    what = int(rng.integers(4))
    elements = all_elements(root)
    element = elements[int(rng.integers(len(elements)))]
    if what == 0:
        element.addprevious(etree.Comment(" a remark "))
    elif what == 1:
        geoms = list(root.iter("geom"))
        geoms[int(rng.integers(len(geoms)))].set("rgba", numbers(*rng.uniform(size=4)))
    elif what == 2:
        visual = etree.SubElement(root, "visual")
        etree.SubElement(visual, "headlight", ambient="0.5 0.5 0.5")
    else:
        root.set("model", "another name")
    return "only seen"


EDITS: list[tuple[float, Callable[[Element, Rng], str | None]]] = [
    (0.35, change_number),
    (0.28, add_attribute),
    (0.08, remove_attribute),
    (0.08, add_element),
    (0.07, add_tie),
    (0.06, remove_element),
    (0.04, reorder),
    (0.04, only_seen),
]


def edited(root: Element, rng: Rng) -> tuple[str, str]:
    """Return (description of the edit, new text)."""
    while True:
        copied = copy.deepcopy(root)
        weights = np.array([weight for weight, _ in EDITS])
        _, edit = EDITS[int(rng.choice(len(EDITS), p=weights / weights.sum()))]
        words = edit(copied, rng)
        if words is not None:
            return words, str(etree.tostring(copied, pretty_print=True, encoding="unicode"))


# -- before and after


@dataclass
class Tally:
    """Result of one edit."""

    edits: int = 0
    refused: int = 0
    goldens: int = 0
    moved: int = 0
    stale: int = 0
    stale_but_still: int = 0
    misses: list[str] = field(default_factory=list)
    crashes: Counter[str] = field(default_factory=Counter)
    still_by_kind: Counter[str] = field(default_factory=Counter)
    stale_by_kind: Counter[str] = field(default_factory=Counter)
    by_kind: Counter[str] = field(default_factory=Counter)


def observe(golden: Golden, realization: Realization) -> tuple[Any, Trace | None]:
    check = check_of(golden.kind)
    observation = check.observe(golden, realization, lambda _: None)
    return observation, check.expect(golden, observation)[1]


def judge(golden: Golden, observation: Any, trace: Trace | None) -> dict[tuple[str, ...], Measure]:
    measures = check_of(golden.kind).compare(golden, observation, trace)
    # The pose in a subject is the worst one, which may differ between runs.
    return {(m.name, m.subject.split(" at ")[0], m.against): m for m in measures}


@dataclass
class Recorded:
    """A golden with its result on the model before the edit."""

    golden: Golden
    trace: Trace | None
    passed: frozenset[tuple[str, ...]]

    def moved(self, realization: Realization) -> str | None:
        """Return the results outside of their tolerance on ``realization``, or None."""
        try:
            observation, _ = observe(self.golden, realization)
            after = judge(self.golden, observation, self.trace)
        except Exception as error:  # a crash of a check is an error of the golden too
            return f"{type(error).__name__}: {error}"
        for key, measure in after.items():
            if not measure.passed and (key in self.passed or measure.against == "golden"):
                return f"{' '.join(key)}: error {measure.error:g} > {measure.tolerance:g}"
        lost = self.passed - after.keys()
        return f"gone: {sorted(lost)[0]}" if lost else None


def record(golden: Golden, realization: Realization, tally: Tally) -> Recorded | None:
    """Record a golden; None if the model does not support it, or it is not repeatable."""
    try:
        check = check_of(golden.kind)
        observation, trace = observe(golden, realization)
        expected, _ = check.expect(golden, observation)
        # The value is the one that is read from the spec.
        golden = replace(golden, expected=json.loads(json.dumps(expected)))
        measures = judge(golden, observe(golden, realization)[0], trace)
    except TwinError:
        return None
    except Exception as error:
        tally.crashes[f"{golden.kind}: {type(error).__name__}: {error}"] += 1
        return None
    failed = [m for m in measures.values() if not m.passed and m.against == "golden"]
    if failed:
        return None
    passed = frozenset(key for key, measure in measures.items() if measure.passed)
    return Recorded(golden, trace, passed) if passed else None


def dependencies(twin: Twin, realization: Realization, goldens: list[Golden]) -> DependencyMap:
    model = Model(realization.parts, realization.structure)
    world = Lookups(check_of, version, lambda golden, reference: None)
    return dependency_map(twin, goldens, {"mujoco": model}, world)


def one_model(folder: Path, rng: Rng, edits: int, tally: Tally, *, precision: bool) -> None:
    """Draw a robot, record goldens on it, and edit it ``edits`` times."""
    robot = Robot(rng)
    path = folder / "model.xml"
    path.write_text(robot.text)
    (folder / "twin.yaml").write_text("model: model.xml\n")
    twin = load_twin(folder / "twin.yaml")
    try:
        before = load(path, twin=twin)
    except TwinError:
        return
    recorded = []
    for i, spec in enumerate(specs(before, rng)):
        spec_path = folder / "golden" / f"{spec['kind']}_{i}.yaml"
        spec_path.parent.mkdir(exist_ok=True)
        spec_path.write_text(json.dumps({"schema": 1, **spec}))
        found = record(load_golden(spec_path, twin), before, tally)
        if found is not None:
            recorded.append(found)
    goldens = [item.golden for item in recorded]
    today = dependencies(twin, before, goldens)
    baseline = Baseline(1, today.parts, dict.fromkeys(today.depends_on, True), today.depends_on)
    for _ in range(edits):
        words, text = edited(robot.root, rng)
        path.write_text(text)
        try:
            after = load(path, twin=twin)
        except TwinError:
            tally.refused += 1
            continue
        tally.edits += 1
        reasons = staleness(dependencies(twin, after, goldens), baseline)
        for item in recorded:
            stale = bool(reasons[f"{item.golden.id}@mujoco"])
            tally.goldens += 1
            tally.stale += stale
            tally.by_kind[item.golden.kind] += 1
            tally.stale_by_kind[item.golden.kind] += stale
            if stale and not precision:
                continue
            moved = item.moved(after)
            tally.moved += moved is not None
            if moved is not None and not stale:
                tally.misses.append(
                    f"{words}: {item.golden.id}: {moved}\n{robot.text}\n---\n{text}"
                )
            if stale and moved is None:
                tally.stale_but_still += 1
                tally.still_by_kind[item.golden.kind] += 1


def run(edits: int, seed: int, *, precision: bool, progress: bool = False) -> Tally:
    """Yield ``edits`` edits that MuJoCo accepts."""
    tally = Tally()
    warnings.simplefilter("ignore")
    number = 0
    while tally.edits < edits:
        rng = np.random.default_rng([seed, number])
        number += 1
        with tempfile.TemporaryDirectory() as folder:
            wanted = min(EDITS_PER_MODEL, edits - tally.edits)
            one_model(Path(folder), rng, wanted, tally, precision=precision)
        if progress:
            print(f"\r{tally.edits}/{edits} edits, {len(tally.misses)} misses", end="", flush=True)
    return tally


def main() -> int:
    """Run and report; return 1 if there was a miss."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--edits", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--misses", type=Path, help="write each miss, with both models, here")
    arguments = parser.parse_args()
    start = time.perf_counter()
    tally = run(arguments.edits, arguments.seed, precision=True, progress=sys.stderr.isatty())
    print(f"{tally.edits} edits ({tally.refused} more that MuJoCo refused), seed {arguments.seed}")
    print(f"{tally.goldens} goldens looked at, {tally.moved} left their tolerance")
    print(f"misses: {len(tally.misses)} (goal 0)")
    needed = tally.stale - tally.stale_but_still
    print(f"called stale: {tally.stale}, of which moved: {needed} ({needed / tally.stale:.0%})")
    for kind, count in sorted(tally.by_kind.items()):
        stale, still = tally.stale_by_kind[kind], tally.still_by_kind[kind]
        print(f"  {kind}: {count}, stale {stale}, of which moved {stale - still}")
    print(f"{time.perf_counter() - start:.0f} s")
    for crash, count in tally.crashes.most_common():
        print(f"{count} times a check crashed on a model as drawn: {crash}")
    for miss in tally.misses:
        print(miss.splitlines()[0])
    if arguments.misses is not None:
        arguments.misses.write_text("\n======\n".join(tally.misses))
    return 1 if tally.misses else 0


if __name__ == "__main__":
    raise SystemExit(main())
