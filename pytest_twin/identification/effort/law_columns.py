"""Efforts of every law of the catalogue along a measured motion, per unit of its amplitudes.

The measured effort is linear in the amplitudes of most laws. Each amplitude is a column, for every
shape from which a fit of that law starts. The laws are those of the catalogue: their hooks are
called on the samples of the motion, without a simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values
from pytest_twin.effects.layout import Layout
from pytest_twin.effects.point_mass import change_links
from pytest_twin.effects.proposal import amplitude_indices, starting_sizes
from pytest_twin.estimation.hypothesis import Scales, Term
from pytest_twin.identification.effort.filtering import Filter, differentiate
from pytest_twin.identification.effort.recording_rows import inner_rows, known_efforts_along
from pytest_twin.identification.known_effects import effort_of_effects, measured_world
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.metrics.pose import rotation_of
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import InverseDynamics

_VISIBLE = ("fields", "friction", "force", "sense_effort", "unsense")
"""Hooks of laws that change the effort along a given motion."""
_SMALL = 0.01
"""Step of an amplitude in multiples of its first start, for laws that are only nearly linear."""
_OF_SURROUNDINGS = ("contact", "environment")
"""Families whose laws are no property of the robot: they differ between recordings."""
_PROBES = 48
"""Number of random states at which laws are compared, to leave out those that efforts cannot
show and those that they cannot distinguish."""
_ALIKE = 1e-9
"""Relative difference of two columns below which they are the same."""
_COLD = 1.0
"""Cold fraction of every recording: it warms up from its start."""
_DIGITS = 6
"""Number of decimals in which equal columns agree."""
_OVERSAMPLED = 3.0
"""Ratio of the rate at which laws are evaluated to the rate of the rows. Positions are filtered at
four times the bandwidth of the rows, so this leaves no motion out."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A law at one joint in one shape, with the columns of its amplitudes.

    Attributes:
        term: the law and its joint; joint -1 for the whole robot.
        values: (parameters,) SI units; the amplitudes are neutral.
        columns: amplitude -> its column.
    """

    term: Term
    values: FloatArray
    columns: Mapping[int, int]

    @property
    def indices(self) -> NDArray[np.intp]:
        """(amplitudes,) its columns."""
        return np.array(list(self.columns.values()), dtype=np.intp)

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Its amplitudes, in the order of ``indices``."""
        return tuple(self.term.parameters[k] for k in self.columns)


@dataclass(frozen=True)
class States:
    """States of a measured motion; arrays are (n, joints) in SI units.

    Attributes:
        time: (n,) s since the start of the recording.
        velocity: 0 where the joint is at rest.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True)
class EffortRows:
    """Rows of one recording, joint by joint.

    Attributes:
        recording: what was measured.
        time: (n,) s.
        effort: (n, joints) measured effort minus that of the model, N*m or N; NaN where unknown.
        columns: for each joint, (k,) indices of the columns that act on it.
        matrix: for each joint, (n, k) effort per unit of these amplitudes.
        tip: (n, joints, 10) effort per unit of each inertial parameter of the last link, in the
            order of ``inverse_dynamics.INERTIAL``.
    """

    recording: MeasuredRecording
    time: FloatArray
    effort: FloatArray
    columns: tuple[NDArray[np.intp], ...]
    matrix: tuple[FloatArray, ...]
    tip: FloatArray


Column = Mapping[int, FloatArray]
"""Joint -> (n,) effort of one amplitude at one place; joints without effort are left out."""


class EffortLaws:
    """The laws of the catalogue that the efforts of a robot can show.

    Attributes:
        joints: names, in the order of the efforts.
        shapes: every law at every joint, in every shape.
        count: number of columns.
        scales: reference scales of the parameters.
        tip: index of the last joint.

    Args:
        scales: reference -> (joints,) typical size in SI units, see
            :data:`~pytest_twin.effects.base.REFERENCES`.
    """

    def __init__(
        self, realization: Realization, joints: Sequence[str], scales: Mapping[str, FloatArray]
    ) -> None:
        self.joints = tuple(joints)
        self.dynamics = InverseDynamics(realization, joints)
        self._model = realization.model
        self._layout = Layout(realization.model, (), joints)
        self.tip = max(range(len(joints)), key=lambda j: self.dynamics.links.index(joints[j]))
        ones = np.ones(len(joints))
        self.scales = Scales({
            **scales,
            "one": ones,
            "mass": ones * max(self._layout.tool_mass, 0.05),
            "length": ones * self._layout.tool_length,
            "gyration": self._layout.gyration,
        })  # fmt: skip
        self._forms = [
            _Form(law, start, self._values(law, start))
            for law in catalogue().values()
            if law.candidate and law.family not in _OF_SURROUNDINGS and law.overrides(*_VISIBLE)
            for start in starting_sizes(law)
        ]
        self.shapes: tuple[Shape, ...] = ()
        self.count = 0
        self._choose_shapes()

    def _values(self, law: Effect, start: FloatArray) -> FloatArray:
        """(parameters, joints) SI values of a start, without its amplitudes."""
        amplitudes = amplitude_indices(law, start)
        return np.array(
            [
                [
                    p.neutral if k in amplitudes else value * self.scales.value(p, joint)
                    for joint in range(len(self.joints))
                ]
                for k, (p, value) in enumerate(zip(law.parameters, start, strict=True))
            ]
        )

    def _choose_shapes(self) -> None:
        """Keep the shapes that random states show, one of those that they do not distinguish."""
        random = np.random.default_rng(0)
        position, velocity, acceleration = random.normal(size=(3, _PROBES, len(self.joints)))
        along = self._along(States(
            np.linspace(0.0, 1.0, _PROBES), position, velocity * self.scales.of["velocity"],
            acceleration,
        ))  # fmt: skip
        seen: dict[Term, list[FloatArray]] = {}
        # A column that several laws share, such as dry friction, is one unknown.
        columns: dict[bytes, int] = {}
        chosen: list[Shape] = []
        for form in self._forms:
            by_amplitude = {k: along.columns(form, k, self._step(form, k)) for k in form.amplitudes}
            for joint in form.places(len(self.joints)):
                whole = np.zeros((len(form.amplitudes), len(self.joints), _PROBES))
                for row, k in enumerate(form.amplitudes):
                    for at, effort_of_one in by_amplitude[k][joint].items():
                        whole[row, at] = effort_of_one
                sizes = np.abs(whole).max(axis=(1, 2))
                term = Term(form.law.id, joint)
                alike = any(
                    other.shape == whole.shape
                    and np.all(np.abs(whole - other).max(axis=(1, 2)) <= _ALIKE * sizes)
                    for other in seen.get(term, [])
                )
                if alike or not sizes.all():
                    continue
                seen.setdefault(term, []).append(whole)
                places = {
                    k: columns.setdefault(_signature(own), len(columns))
                    for k, own in zip(form.amplitudes, whole, strict=True)
                }
                form.shapes[joint] = Shape(term, form.values[:, max(joint, 0)], places)
                chosen.append(form.shapes[joint])
        self.shapes, self.count = tuple(chosen), len(columns)
        self._forms = [form for form in self._forms if form.shapes]

    def _step(self, form: _Form, amplitude: int) -> FloatArray:
        """(joints,) amplitude at which the effort is taken, SI units."""
        p = form.law.parameters[amplitude]
        start = next(abs(s) for s in p.starts if s)
        scale = [self.scales.value(p, joint) for joint in range(len(self.joints))]
        return _SMALL * start * np.array(scale)

    @property
    def tip_axes(self) -> FloatArray:
        """(3, 3) own axes of a payload on the last link as rows, in the frame of its joint."""
        (axes,) = self._layout.payload_axes(np.array([self.tip]))
        name = self._model.body(self._layout.body_index[self.tip]).name
        link = self.dynamics.links.index(self.joints[self.tip])
        bodies = self.dynamics.bodies_of(self.dynamics.link_ids[link])
        placement = next(body.placement for body in bodies if body.name == name)
        return np.asarray(axes @ placement.rotation.T, dtype=np.float64)

    def _along(self, states: States) -> _Along:
        return _Along(self._model, self._layout, self.dynamics, states)

    def rows(
        self,
        recording: MeasuredRecording,
        chosen: Filter,
        rest: FloatArray,
        payload: FloatArray | None = None,
    ) -> EffortRows:
        """Rows of a recording.

        Args:
            rest: (joints,) speeds below which a joint is at rest.
            payload: (links, 10) inertial parameters that a declared payload adds; None without one.
        """
        motion = differentiate(recording, chosen, _OVERSAMPLED)
        moving = np.where(np.abs(motion.velocity) > rest, motion.velocity, 0.0)
        measured = motion.effort + known_efforts_along(recording, motion, rest)
        along = self._along(States(
            recording.start + motion.time, motion.position, moving, motion.acceleration
        ))  # fmt: skip
        carried = 0.0 if payload is None else along.effort_of(payload)
        rows: list[dict[int, FloatArray]] = [{} for _ in self.joints]
        for form in self._forms:
            for k in form.amplitudes:
                of_joint = along.columns(form, k, self._step(form, k))
                for joint, shape in form.shapes.items():
                    for at, effort in of_joint[joint].items():
                        rows[at].setdefault(shape.columns[k], effort)
        smooth = [inner_rows(np.stack(list(own.values()), axis=1), motion, chosen) for own in rows]
        tip = along.of_link(self.joints[self.tip])
        tip_rows = inner_rows(tip.reshape(len(tip), -1), motion, chosen)
        return EffortRows(
            recording,
            inner_rows(motion.time[:, None], motion, chosen)[:, 0],
            inner_rows(measured - along.nominal - carried, motion, chosen),
            tuple(np.array(list(own), dtype=np.intp) for own in rows),
            tuple(smooth),
            tip_rows.reshape(len(tip_rows), *tip.shape[1:]),
        )


def _signature(column: FloatArray) -> bytes:
    """Key of a column; equal for equal columns."""
    digits: FloatArray = np.round(column / np.abs(column).max(), _DIGITS) + 0.0
    return digits.tobytes()


@dataclass
class _Form:
    """A law in one shape at all joints.

    Attributes:
        start: (parameters,) in multiples of references.
        values: (parameters, joints) SI units; the amplitudes are neutral.
        shapes: joint -> the shape that represents this form there.
    """

    law: Effect
    start: FloatArray
    values: FloatArray
    shapes: dict[int, Shape] = field(default_factory=dict)

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Indices of its amplitudes."""
        return amplitude_indices(self.law, self.start)

    def places(self, joints: int) -> Sequence[int]:
        """Joints at which it acts; -1 for the whole robot."""
        return range(joints) if self.law.scope == "joint" else (-1,)

    def with_amplitude(self, amplitude: int, size: FloatArray) -> dict[str, FloatArray]:
        """Parameter -> (1, joints) values with one amplitude at all joints."""
        values = self.values.copy()
        values[amplitude] = values[amplitude] + size
        return {p.name: x[None] for p, x in zip(self.law.parameters, values, strict=True)}


class _Along:
    """Evaluates laws along one motion.

    Attributes:
        nominal: (n, joints) effort that the model takes for the motion, N*m or N.
    """

    def __init__(
        self, model: mujoco.MjModel, layout: Layout, dynamics: InverseDynamics, states: States
    ) -> None:
        self._model, self._layout, self._dynamics, self._states = model, layout, dynamics, states
        self._period = float(states.time[1] - states.time[0])
        self._bodies = dynamics.regressor(states.position, states.velocity, states.acceleration)
        inertial = dynamics.parameters
        # The load is the effort without acceleration.
        self._slopes = dynamics.derivatives(
            states.position, states.velocity, states.acceleration, inertial
        )
        needed = np.einsum("njlp,lp->nj", self._bodies, inertial)
        self._load = needed - np.einsum("njk,nk->nj", self._slopes[2], states.acceleration)
        dofs = layout.dof_index
        passive = model.dof_damping[dofs] * states.velocity
        passive += model.dof_frictionloss[dofs] * np.sign(states.velocity)
        self.nominal: FloatArray = needed + dynamics.armature * states.acceleration + passive
        self._link = {name: k for k, name in enumerate(dynamics.links)}

    def effort_of(self, inertial: FloatArray) -> FloatArray:
        """(n, joints) effort of (links, 10) inertial parameters, N*m or N."""
        found: FloatArray = np.einsum("njlp,lp->nj", self._bodies, inertial)
        return found

    def of_link(self, joint: str) -> FloatArray:
        """(n, joints, 10) effort per unit of each inertial parameter of a joint's link."""
        return np.asarray(self._bodies[:, :, self._link[joint]], dtype=np.float64)

    def columns(self, form: _Form, amplitude: int, step: FloatArray) -> Mapping[int, Column]:
        """Joint of the law -> its column, per unit of the amplitude.

        Args:
            step: (joints,) amplitude at which the effort is taken, SI units.
        """
        law, values = form.law, form.with_amplitude(amplitude, step)
        whole_robot = law.scope == "robot"
        joints = range(len(self._layout.joints))
        found: dict[int, dict[int, FloatArray]] = {
            j: {} for j in ((-1,) if whole_robot else joints)
        }

        def add(of: int, at: int, effort: FloatArray) -> None:
            if effort.any():
                place = -1 if whole_robot else of
                found[place][at] = found[place].get(at, 0.0) + effort / step[max(place, 0)]

        own = -self._pushed(law, values)
        if law.overrides("sense_effort"):
            wide = {name: np.broadcast_to(x, own.shape) for name, x in values.items()}
            # The measured effort itself would explain every effort.
            own = own + law.sense_effort(self.nominal[:, None], wide)[:, 0] - self.nominal
        fields = self._fields(law, values)
        own = own + fields.armature * self._states.acceleration
        for j in joints:
            add(j, j, own[:, j])
        if fields.has_changed_links:
            changes = self._changed_links(fields)
            for j, joint in enumerate(self._layout.joints):
                link = self._link[joint]
                effort = self._bodies[:, :, link] @ changes[link]
                for at in joints:
                    add(j, at, effort[:, at])
        turned = fields.gravity[0] - self._model.opt.gravity
        if turned.any():
            effort = self._dynamics.weights(self._states.position, turned)
            for at in joints:
                add(-1, at, effort[:, at])
        if law.overrides("unsense"):
            moved = self._moved(law, values)
            for j in joints:
                effort = np.sum(
                    [
                        slope[:, :, j] * x[:, j, None]
                        for slope, x in zip(self._slopes, moved, strict=True)
                    ],
                    axis=0,
                )
                for at in joints:
                    add(j, at, effort[:, at])
        return found

    def _pushed(self, law: Effect, values: Values) -> FloatArray:
        """(n, joints) effort by which a law pushes the joints."""
        states, found = self._states, np.zeros_like(self._states.position)
        if not law.overrides("fields", "friction", "force"):
            return found
        if not law.remembers:
            wide = {name: np.broadcast_to(x, found.shape) for name, x in values.items()}
            world = measured_world(
                states.time, self._period, states.position, states.velocity,
                self.nominal, self._load, _COLD,
            )  # fmt: skip
            return effort_of_effects(world, [(law, wide)])
        zero = np.zeros((1, found.shape[1]))
        world = measured_world(states.time[:1], self._period, zero, zero, zero, zero, _COLD)
        for k in range(len(found)):
            now = slice(k, k + 1)
            world.time, world.position = states.time[now], states.position[now]
            world.velocity, world.delivered = states.velocity[now], self.nominal[now]
            world.load, world.applied, world.friction_level = self._load[now], zero.copy(), zero
            law.friction(world, values)
            law.force(world, values)
            found[k] = (world.applied - world.friction_level * np.sign(world.velocity))[0]
        return found

    def _fields(self, law: Effect, values: Values) -> ModelFields:
        gravity = np.asarray(self._model.opt.gravity, dtype=np.float64)
        fields = ModelFields.neutral(gravity[None].copy(), len(self._layout.joints))
        law.fields(fields, values)
        return fields

    def _changed_links(self, fields: ModelFields) -> FloatArray:
        """(links, 10) change of the inertial parameters of links."""
        model = self._model
        mass, center, moments, quat = (
            np.array(getattr(model, name), dtype=np.float64)[None]
            for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat")
        )
        change_links(
            self._layout, fields, (mass, center, moments, quat), np.array(model.jnt_pos)[None]
        )
        bodies = {}
        for body in np.unique(self._layout.body_index):
            axes = rotation_of(quat[0, body])
            tensor = axes @ np.diag(moments[0, body]) @ axes.T
            bodies[model.body(body).name] = np.concatenate(
                [[mass[0, body]], center[0, body], tensor.ravel()]
            )
        return self._dynamics.change_of(bodies)

    def _moved(self, law: Effect, values: Values) -> tuple[FloatArray, FloatArray, FloatArray]:
        """True minus recorded motion: positions, velocities and accelerations, (n, joints)."""
        states = self._states
        wide = {name: np.broadcast_to(x, states.position.shape) for name, x in values.items()}
        position, velocity = law.unsense(states.position, states.velocity, wide)
        faster = velocity - states.velocity
        return position - states.position, faster, np.gradient(faster, self._period, axis=0)
