"""Build the least-squares problem of a plan and its observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.chain import (
    ChainParameters,
    LinkParameter,
    forward,
    link_parameters,
)
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.parameters import Layout, State, Variables
from pytest_twin.calibration.plan import Mount, Plan
from pytest_twin.calibration.terms import PivotTerm, PointTerm, PoseTerm, Term
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian
from pytest_twin.errors import FormatError
from pytest_twin.metrics.pose import inverse, rigid
from pytest_twin.realization.serial_chain import SerialChain

MOUNTED, WORLD = "mounted", "world"
"""The two poses of a measurement: of the body that the flange carries, in the flange, and of the
fixed body, in the base."""

TIP = "tip"
MARKER, PIVOT = "marker.", "pivot."
"""Names of points: the tip of a pivoting tool, a marker on the flange, a fixed point."""


def marker_of(point: str) -> str:
    """Return the marker's name in the file of observations."""
    return point.removeprefix(MARKER)


@dataclass(frozen=True)
class CalibrationProblem:
    """Least-squares problem: terms, unknowns and the robot's kinematics.

    Attributes:
        observations: the rows that the terms index.
        chain: kinematic chain of the robot; None if flange poses are given.
        fixed: values of the fixed parameters.
        camera_unit: length of one unit of the camera's positions, m; approximate if the scale is
            estimated.
    """

    plan: Plan
    observations: Observations
    chain: SerialChain | None
    terms: tuple[Term, ...]
    layout: Layout
    fixed: State
    notes: tuple[str, ...] = ()
    camera_unit: float = 1.0

    @property
    def is_odometry(self) -> bool:
        """Whether only poses of a camera's own odometry or SLAM were measured.

        Its errors accumulate along the path, so neighbouring poses share nearly all of them. If
        they were assumed independent, the intervals would be far too narrow.
        """
        return self.plan.has_free_scale and len(self.terms) == 1

    def flange(self, variables: Variables) -> TransformWithJacobian:
        """``transform_base_to_flange`` of all rows, with derivatives."""
        if self.chain is not None:
            return forward(self.chain, self.readings, variables.chain())
        assert self.observations.flange is not None
        count = len(self.observations)
        nothing = np.zeros((count, 3, variables.layout.count))
        poses = self.observations.flange
        return TransformWithJacobian(poses[:, :3, :3], poses[:, :3, 3], nothing, nothing)

    @property
    def readings(self) -> FloatArray:
        """(rows, joints) joint readings, rad or m."""
        assert self.chain is not None
        joints = [self.observations.joints[name] for name in self.chain.joints]
        return np.stack(joints, axis=1) if joints else np.zeros((len(self.observations), 0))

    def residuals(self, state: State, step: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return residuals (m, columns) and derivatives (m, columns, count) of each term."""
        variables = Variables(self.layout, state, step)
        flange = self.flange(variables)
        return [term.residuals(flange, variables) for term in self.terms]

    def on_rows(self, chosen: Sequence[int] | np.ndarray) -> CalibrationProblem:
        """Return the same problem on the chosen rows of the observations."""
        return self.with_observations(self.observations.rows(chosen))

    def with_observations(self, observations: Observations) -> CalibrationProblem:
        """Return the same problem on other observations of the same kinds."""
        terms = terms_of(self.plan, observations, self.chain is not None, self.camera_unit)
        return replace(self, observations=observations, terms=terms)

    def in_unit(self, camera_unit: float) -> CalibrationProblem:
        """Return the same problem with another unit of the camera's positions, m."""
        return replace(self, camera_unit=camera_unit).with_observations(self.observations)


def arms(problem: CalibrationProblem) -> tuple[CalibrationProblem, ...]:
    """Return the problem with joint zeros free too, and with link geometry free too."""
    if problem.chain is None:
        return ()
    names = problem.plan.estimate
    wider = []
    for free in (("joint_zeros",), ("joint_zeros", "geometry")):
        plan = replace(problem.plan, estimate=tuple(dict.fromkeys((*names, *free))))
        made = make_problem(plan, problem.observations, problem.chain)
        wider.append(made.in_unit(problem.camera_unit))
    return tuple(wider)


def reported_flange(chain: SerialChain | None, observations: Observations) -> FloatArray | None:
    """(rows, 4, 4) flange pose reported by the robot, m; None without robot and flange poses."""
    if observations.flange is not None:
        return observations.flange
    if chain is None or any(name not in observations.joints for name in chain.joints):
        return None
    readings = np.stack([observations.joints[name] for name in chain.joints], axis=1)
    held = ChainParameters(0, np.zeros(len(chain.joints)), (-1,) * len(chain.joints))
    moving = forward(chain, readings, held)
    return rigid(moving.rotation, moving.position)


def make_problem(
    plan: Plan, observations: Observations, chain: SerialChain | None
) -> CalibrationProblem:
    """Build the least-squares problem of a plan.

    Raises:
        SpecError: the observations lack what the plan asks for.
        FormatError: a joint's column is missing or has an empty cell.
    """
    if chain is not None and not _has_joints(plan, observations, chain):
        chain = None
    terms = terms_of(plan, observations, chain is not None)
    _check_terms(plan, terms)
    needs_chain = [name for name in ("joint_zeros", "geometry") if name in plan.estimate]
    if needs_chain and chain is None:
        raise plan.error(
            "estimate",
            f"{needs_chain[0]} without a robot",
            expected="robot: a URDF, MJCF or twin.yaml, and joint.NAME columns",
        )
    poses: dict[str, FloatArray] = {}
    points: dict[str, FloatArray] = {}
    free_poses: list[str] = []
    free_points: list[str] = []
    notes: list[str] = list(observations.notes)
    for term in terms:
        match term:
            case PoseTerm():
                for role, name in ((WORLD, term.world), (MOUNTED, term.mounted)):
                    _add_pose(plan, name, role, poses, free_poses, notes)
            case PointTerm():
                _add_pose(plan, term.world, WORLD, poses, free_poses, notes)
                if term.mounted is not None:
                    _add_pose(plan, term.mounted, MOUNTED, poses, free_poses, notes)
                    points[term.point] = plan.points[marker_of(term.point)]
                elif "tcp" in plan.given and len(observations.points) == 1:
                    points[term.point] = plan.given["tcp"][:3, 3]
                else:
                    points[term.point] = np.zeros(3)
                    free_points.append(term.point)
            case PivotTerm():
                for name in (term.tip, term.pivot):
                    if name not in points:
                        points[name] = np.zeros(3)
                        free_points.append(name)
    zeros: tuple[int, ...] = ()
    joints: tuple[str, ...] = ()
    links: tuple[LinkParameter, ...] = ()
    if chain is not None:
        joints = chain.joints
        zeros = tuple(range(len(joints))) if "joint_zeros" in plan.estimate else ()
        if "geometry" in plan.estimate:
            base_is_free = any(name.endswith(WORLD) for name in free_poses) or bool(
                [name for name in free_points if name.startswith(PIVOT)]
            )
            links = link_parameters(chain, 1 if base_is_free else 0, zeros_are_free=bool(zeros))
    seen = any(isinstance(term, PoseTerm) for term in terms)
    layout = Layout(
        tuple(free_poses),
        tuple(free_points),
        zeros,
        joints,
        () if chain is None else tuple(bool(one) for one in chain.revolute),
        links,
        plan.priors.joint_zeros,
        plan.priors.geometry_translation,
        plan.priors.geometry_rotation,
        plan.has_free_scale or (seen and plan.target_tolerance > 0.0),
        None if plan.has_free_scale else plan.target_tolerance,
    )
    fixed = State(poses, points, np.zeros(len(joints)), np.zeros(len(links)))
    return CalibrationProblem(
        plan, observations, chain, terms, layout, fixed, tuple(dict.fromkeys(notes))
    )


def _check_terms(plan: Plan, terms: tuple[Term, ...]) -> None:
    if not terms:
        raise plan.error(
            "observations",
            "no observation that could be compared with the robot",
            expected="camera_from_target.x y z qw qx qy qz, point.NAME.x y z, or estimate: [tcp] "
            "for a pivoting tool",
        )
    tips = [t.name for t in terms if isinstance(t, PointTerm) and t.mounted is None]
    # With poses, pivots or markers at known places beside them, these give the tool.
    if "tcp" in plan.estimate and len(tips) > 1 and len(tips) == len(terms):
        raise plan.error(
            "estimate",
            f"tcp, and several points without a position in the tool: {', '.join(tips)}",
            expected="target: {kind: points, points: {NAME: [x, y, z]}} with the places of markers "
            "in the tool; or one column point.TIP with the nominal place that the tip touches in "
            "each row",
        )
    if plan.has_free_scale and not any(isinstance(term, PoseTerm) for term in terms):
        raise plan.error(
            "camera.scale",
            "a scale to estimate, but no poses of a camera",
            expected="camera_from_target.x y z qw qx qy qz in observations",
        )


def _has_joints(plan: Plan, observations: Observations, chain: SerialChain) -> bool:
    """Whether joint readings are used. If they are missing, flange poses are used.

    Raises:
        FormatError: a required joint is missing.
    """
    needed = {"joint_zeros", "geometry"} & set(plan.estimate)
    if observations.flange is not None and not needed:
        joints = [observations.joints.get(name) for name in chain.joints]
        if any(values is None or np.isnan(values).any() for values in joints):
            return False
    _check_joints(plan, observations, chain)
    return True


def _check_joints(plan: Plan, observations: Observations, chain: SerialChain) -> None:
    for name in chain.joints:
        values = observations.joints.get(name)
        path = plan.observations[0] if plan.observations else plan.path
        if values is None:
            raise FormatError(
                f"no column of joint {name!r}, which moves {chain.frame!r}",
                path=path,
                where=f"joint.{name}",
                value=", ".join(observations.joints) or None,
                expected=f"a column joint.{name} with its position in rad (m where it slides)",
            )
        empty = np.flatnonzero(np.isnan(values))
        if len(empty):
            raise FormatError(
                "an observation without a joint's position",
                path=path,
                where=f"joint.{name}",
                value=f"id {observations.ids[int(empty[0])]}",
                expected="a position of every joint between base and flange in every row",
            )


def terms_of(
    plan: Plan, observations: Observations, has_chain: bool, camera_unit: float = 1.0
) -> tuple[Term, ...]:
    """Return one residual term for each kind of measurement; the camera's positions are in m.

    Raises:
        SpecError: there is neither a robot nor flange poses.
    """
    usable = np.ones(len(observations), dtype=bool)
    if not has_chain:
        if observations.flange is None:
            raise plan.error(
                "robot",
                "neither a robot nor flange poses",
                expected="robot: a URDF, or columns flange.x y z qw qx qy qz",
            )
        usable = np.asarray(np.isfinite(observations.flange).all(axis=(1, 2)))
    found: list[Term] = []
    measured = np.zeros(len(observations), dtype=bool)
    poses = observations.camera_from_target
    if poses is not None:
        there = usable & np.isfinite(poses).all(axis=(1, 2))
        measured |= there
        rows = np.flatnonzero(there)
        if len(rows):
            metric = poses[rows].copy()
            metric[:, :3, 3] *= camera_unit
            found.append(PoseTerm(rows, metric, plan.mount))
    known = set(plan.points) & set(observations.points)
    for name, values in observations.points.items():
        there = usable & np.isfinite(values).all(axis=1)
        measured |= there
        rows = np.flatnonzero(there)
        if len(rows):
            mounted = "tracker.mounted" if name in known else None
            found.append(PointTerm(rows, values[rows], f"{MARKER}{name}", mounted))
    if "tcp" in plan.estimate:
        # A row without any other measurement states that the tip is at the fixed point.
        names = observations.pivots or ("",) * len(observations)
        only_pivots = not measured.any()
        for pivot in dict.fromkeys(names):
            if not pivot and not only_pivots:
                continue
            same = np.array([name == pivot for name in names])
            rows = np.flatnonzero(usable & ~measured & same)
            if len(rows):
                found.append(PivotTerm(rows, f"{PIVOT}{pivot or 'point'}"))
    return tuple(found)


def records_of(role: str, family: str, mount: Mount) -> tuple[str, ...]:
    """Return the names of the records for one pose of the transform chain."""
    if family == "camera" and mount == "world":
        return ("tcp",) if role == MOUNTED else ("hand_eye", "base_world", "robot_world")
    if role == MOUNTED:
        return ("hand_eye",) if family == "camera" else ("tcp",)
    return ("base_world", "robot_world", "fixture")


INVERTED_RECORDS = frozenset({"base_world"})
"""Records with the pose of the base in the world. All other records have poses in the base or
flange."""

_WORDS = {
    ("camera", "hand", MOUNTED): "the camera on the flange",
    ("camera", "hand", WORLD): "the target in the base",
    ("camera", "world", MOUNTED): "the target on the flange",
    ("camera", "world", WORLD): "the camera in the base",
    ("tracker", "hand", MOUNTED): "the tool on the flange",
    ("tracker", "hand", WORLD): "the measuring frame in the base",
}


def describe_pose(name: str, mount: Mount) -> str:
    """Describe a pose of the transform chain, such as "the camera on the flange"."""
    family, _, role = name.partition(".")
    return _WORDS[family, mount if family == "camera" else "hand", role]


def _add_pose(
    plan: Plan,
    name: str,
    role: str,
    poses: dict[str, FloatArray],
    free: list[str],
    notes: list[str],
) -> None:
    if name in poses:
        return
    names = records_of(role, name.partition(".")[0], plan.mount)
    for record in names:
        if record in plan.given:
            transform = plan.given[record]
            inverted = record in INVERTED_RECORDS
            poses[name] = inverse(transform) if inverted else transform
            return
    poses[name] = np.eye(4)
    free.append(name)
    if not set(names) & set(plan.estimate):
        notes.append(
            f"the pose of {describe_pose(name, plan.mount)} is neither given nor in estimate; "
            f"it is estimated with the rest (to hold it: given: {{{names[0]}: ...}})"
        )


def predicted_poses(problem: CalibrationProblem, state: State) -> FloatArray:
    """(rows, 4, 4) predicted ``transform_base_to_flange`` at a state, m."""
    nothing = np.zeros(problem.layout.count)
    flange = problem.flange(Variables(problem.layout, state, nothing))
    return rigid(flange.rotation, flange.position)
