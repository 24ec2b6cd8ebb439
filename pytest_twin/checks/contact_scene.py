"""The scene of a contact golden: robot, surroundings, commands and forces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from pytest_twin.checks.base import Progress
from pytest_twin.checks.fields import (
    EFFORT_UNIT,
    POSITION_UNIT,
    known_name,
    quantity,
    seconds,
    spec_error,
)
from pytest_twin.checks.poses import REFERENCE, resolve_pose
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.realization import Realization
    from pytest_twin.realization.scene import FreeObject
    from pytest_twin.realization.simulate import SimulatedMotion

OBJECT, FLOOR = "object", "floor"
"""Names in a pair for the object and floor that the golden declares."""
SIZES: Mapping[str, int] = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}
"""Shape of an object -> number of half sizes."""
_RAMP = 0.2  # s
_GAP = 0.01  # m


class Scene:
    """The robot with its surroundings, commands and forces.

    Attributes:
        model, data: model and state to step.
        geoms, bodies: geoms and bodies of the first and the second of the pair.
        object_body: the free object's body, or None.

    Raises:
        SpecError: the model lacks a name, a value is out of bounds, or a field that the
            primitive needs is missing.
    """

    def __init__(self, golden: Golden, realization: Realization) -> None:
        from pytest_twin.realization import scene, simulate

        self.golden, self.realization = golden, realization
        stimulus, target = golden.stimulus, golden.target
        self._check_names()
        free = _free_object(golden)
        floor = target.get("floor")
        height = None if floor is None else quantity(golden, "target.floor", floor, "m")
        pose = resolve_pose(golden, realization, stimulus.get("pose", REFERENCE), "stimulus.pose")
        self.commands = self._commands()
        self.efforts = self._efforts()
        locked: set[str] = set()
        if stimulus.get("others", "free") == "locked":
            driven = {
                joint
                for actuator in stimulus.get("command", {})
                for joint in realization.structure.actuator_joints.get(actuator, ())
            } | set(stimulus.get("effort", {}))
            tied = {t for joint in driven for t in simulate.coupled_joints(realization, joint)}
            locked = set(realization.joints) - tied
        self.model = simulate.prepare_model(
            realization,
            gravity=stimulus.get("gravity", True),
            locked=sorted(locked),
            edit=scene.scene_of(free, height),
        )
        self.data = simulate.initial_state(self.model, realization, pose.qpos)
        self.data.ctrl[:] = simulate.hold(self.model, self.data)
        self.held = np.array(self.data.ctrl)
        self.geoms = (self._geoms(0), self._geoms(1))
        self.bodies = [scene.body_of(self.model, geoms) for geoms in self.geoms]
        self.object_body = None if free is None else scene.object_body(self.model)
        self.ramp = self.seconds("ramp", _RAMP)
        self.press = quantity(golden, "stimulus.press", stimulus.get("press", 0.0), "N")
        self.direction = np.zeros(3)
        self._place_object(golden)

    # -- reading the spec

    def seconds(self, name: str, default: float | None = None) -> float:
        """Return a time of the stimulus, s."""
        where = f"stimulus.{name}"
        given = self.golden.stimulus.get(name, default)
        if given is None:
            raise spec_error(self.golden, where, "is missing", expected="a time such as '0.5 s'")
        return seconds(self.golden, where, given)

    def _check_names(self) -> None:
        target, structure = self.golden.target, self.realization.structure
        known = set(structure.geom_body) | set(structure.collision_bodies)
        known |= {name for name in (OBJECT, FLOOR) if name in target}
        for i, name in enumerate(target["pair"]):
            known_name(self.golden, f"target.pair.{i}", name, known, "geom or body that collides")
        primitive = target["primitive"]
        needed = {"slide": ("stimulus", "slide"), "grip": ("stimulus", "hold")}
        if primitive in needed and needed[primitive][1] not in self.golden.stimulus:
            raise spec_error(
                self.golden,
                ".".join(needed[primitive]),
                f"a {primitive} needs it",
                expected="the field " + needed[primitive][1] + " of the stimulus",
            )
        if primitive == "grip" and OBJECT not in target:
            raise spec_error(
                self.golden,
                "target.object",
                "a grip needs one",
                expected="an object to hold: its shape, size and mass",
            )

    def _geoms(self, i: int) -> frozenset[int]:
        from pytest_twin.realization import scene

        name = self.golden.target["pair"][i]
        own = name in (OBJECT, FLOOR) and name in self.golden.target
        return scene.geoms_of(self.model, name, own)

    def _commands(self) -> dict[int, float]:
        found = {}
        for actuator, value in self.golden.stimulus.get("command", {}).items():
            where = f"stimulus.command.{actuator}"
            known_name(self.golden, where, actuator, self.realization.actuators, "actuator")
            found[self.realization.control_index(actuator)] = float(value)
        return found

    def _efforts(self) -> dict[int, float]:
        found = {}
        types = self.realization.structure.joint_type
        known = [joint for joint, kind in types.items() if kind in POSITION_UNIT]
        for joint, value in self.golden.stimulus.get("effort", {}).items():
            where = f"stimulus.effort.{joint}"
            known_name(self.golden, where, joint, known, "hinge or slide joint")
            unit = EFFORT_UNIT[types[joint]]
            found[self.realization.joint_dof_index(joint)] = quantity(
                self.golden, where, value, unit
            )
        return found

    def _place_object(self, golden: Golden) -> None:
        import mujoco

        from pytest_twin.realization import scene

        model, data = self.model, self.data
        mujoco.mj_kinematics(model, data)
        given = golden.target.get("object")
        primitive = golden.target["primitive"]
        gap = quantity(golden, "stimulus.gap", golden.stimulus.get("gap", _GAP), "m")
        lifted = None
        if given is not None:
            joint = scene.free_joint(model, scene.object_body(model))
            assert joint is not None
            offset = np.asarray(given.get("offset", (0.0, 0.0, 0.0)), dtype=np.float64)
            pose = np.eye(4)
            if "frame" in given:
                frames = self.realization.structure.frame_body
                name = known_name(golden, "target.object.frame", given["frame"], frames, "frame")
                pose = self.realization.frame_pose(data, name)
                pose[:3, 3] += pose[:3, :3] @ offset
            else:
                pose[:3, 3] = data.geom_xpos[min(self.geoms[1])] + offset
                if OBJECT in golden.target["pair"][:1]:
                    lifted = joint
            scene.set_free_joint(model, data, joint, pose)
            if primitive != "grip":
                scene.set_weight(model, scene.object_body(model), True)
        if given is None and primitive == "release":
            lifted = scene.free_joint(model, self.bodies[0])
        if primitive == "release" and scene.free_joint(model, self.bodies[0]) is None:
            raise spec_error(
                golden,
                "target.pair.0",
                "is fixed to the world and cannot be let go",
                value=golden.target["pair"][0],
                expected="'object', or a body of a robot with a free base",
            )
        if lifted is not None:
            scene.lift_above(model, data, lifted, self.geoms[0], self.geoms[1], gap)
        mujoco.mj_fwdPosition(model, data)
        if self.object_body is not None:
            inside = scene.penetrated_geom(model, data, self.object_body)
            if inside is not None:
                raise spec_error(
                    golden, "target.object", f"starts inside {inside!r}", expected="a free place"
                )

    # -- acting

    def run(
        self,
        duration: float,
        record: Callable[[], None],
        progress: Progress,
        *,
        more: Callable[[float], None] | None = None,
    ) -> SimulatedMotion:
        """Continue the simulation for ``duration`` s under commands, efforts and pressing force.

        Args:
            duration: time to simulate, s.
            record: called after each step.
            progress: called with the fraction done.
            more: adds forces; called with the time since the start of this run, s.
        """
        import mujoco

        from pytest_twin.realization import scene, simulate

        model, data = self.model, self.data
        if self.press and not self.direction.any():
            mujoco.mj_kinematics(model, data)
            self.direction = scene.distance(model, data, *self.geoms)[1]
        begin = float(data.time)

        def before(time: float) -> None:
            # The ramp ends in the first run and is not repeated in a second one.
            share = min(1.0, time / self.ramp)
            data.qfrc_applied[:] = 0.0
            for control, value in self.commands.items():
                data.ctrl[control] = self.held[control] + share * (value - self.held[control])
            for dof, value in self.efforts.items():
                data.qfrc_applied[dof] = share * value
            if self.press:
                body = self.bodies[0]
                force = share * self.press * self.direction
                scene.push(model, data, body, force, data.xipos[body])
            if more is not None:
                more(time - begin)

        return simulate.simulate(
            model,
            data,
            simulate.steps_in(model, duration),
            before=before,
            after=lambda _: record(),
            progress=progress,
        )

    def never_touched(self) -> NoReturn:
        """Raise an error for a pair that did not touch."""
        import mujoco

        from pytest_twin.realization import scene

        mujoco.mj_kinematics(self.model, self.data)
        gap = scene.distance(self.model, self.data, *self.geoms)[0]
        raise spec_error(
            self.golden,
            "target.pair",
            f"the pair never touched: {gap:.4g} m apart at the end",
            value=" and ".join(self.golden.target["pair"]),
            expected="a stimulus that brings it together, and geoms that may collide",
        )


def _free_object(golden: Golden) -> FreeObject | None:
    from pytest_twin.realization import scene

    given = golden.target.get("object")
    if given is None:
        return None
    size = tuple(
        quantity(golden, f"target.object.size.{i}", value, "m")
        for i, value in enumerate(given["size"])
    )
    if len(size) != SIZES[given["shape"]] or min(size) <= 0.0:
        raise spec_error(
            golden,
            "target.object.size",
            f"not the size of a {given['shape']}",
            value=given["size"],
            expected=f"{SIZES[given['shape']]} half sizes of more than 0 m",
        )
    mass = quantity(golden, "target.object.mass", given["mass"], "kg")
    if not mass > 0.0:
        raise spec_error(
            golden,
            "target.object.mass",
            "no mass",
            value=mass,
            unit="kg",
            expected="more than 0 kg",
        )
    return scene.FreeObject(given["shape"], size, mass, given.get("friction"))
