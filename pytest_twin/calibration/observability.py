"""Find directions of the unknowns that the observations do not determine, and describe them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import POSE_LABELS, Layout, State
from pytest_twin.calibration.problem import PIVOT, TIP, CalibrationProblem, describe_pose, marker_of
from pytest_twin.calibration.solve import Fit, whitened_jacobian
from pytest_twin.calibration.workspace import draw_flanges, draw_joints, predict_rows, spread

UNDETERMINED_RAD = 0.05
"""Standard deviation of an angle above which it is not determined. No robot task could use it."""

UNDETERMINED_M = 0.05
"""Standard deviation of a position above which it is not determined."""

FEIGNED_FACTOR = 3.0
"""Noise of n poses alone adds n to the information about a direction that the poses do not excite
(Lu, Zhang, Xue: errors in variables). Information below the square of this factor times n is
therefore not counted."""

UNSEEN_ERROR = {"translation": 1e-4, "rotation": 1e-3, "point": 1e-3}
"""Smallest noise for computing the information, m and rad. If all poses are similar, errors from
joint zeros, bending and lens distortion are the same in each pose and do not appear in the
residuals. A good arm has errors of 1 mrad and 1 mm; the position of a target in a camera has 0.1
mm."""

LARGEST_NOISE = {"translation": 0.003, "rotation": 0.01, "point": 0.003}
"""Largest noise for computing the information, m and rad. Larger residuals come from a wrong model
or wrong input and tell nothing about the poses."""

FAR_WIDER = 3.0
"""The unknowns are not determined if their uncertainty alone makes predictions in the workspace
worse than the plan accepts by this factor. For comparison: from poses in a part of the workspace,
tilted by 20 degrees, the other poses are predicted with twice the error."""

STRUCTURAL = 1e-7
"""Fraction of the largest singular value below which a singular value is zero up to rounding."""

AFFECTED = 0.02
"""Fraction of a direction's largest component above which a coordinate belongs to the direction.
Rounding errors are about 1e-6."""

_DRAWN_ROWS = 60
"""Number of random poses for the analysis of the structure."""
_NOISE = {"translation": 1e-3, "rotation": 1e-3, "point": 1e-3, "pixel": 1.0}
"""Noise that is assumed for the analysis of the structure, m, rad, m and px."""


FEWEST_HELD_OUT = 3
"""Fewest held-out observations that can test a frame on their own: two motions determine it."""


@dataclass(frozen=True)
class Gauge:
    """A joint zero that another unknown can always replace, and that is therefore fixed.

    Attributes:
        words: a sentence for people.
    """

    joint: int
    words: str


def hold_gauges(
    problem: CalibrationProblem, state: State
) -> tuple[CalibrationProblem, tuple[Gauge, ...]]:
    """Fix the joint zeros that no set of poses could determine (gauge freedoms).

    A rotation of a free base is equivalent to one of the first joint, and a rotation of a free
    camera on the flange to one of the last joint. The structure is analysed at random joint
    positions, so that similarity of the observed poses has no influence.
    """
    found: list[Gauge] = []
    while problem.layout.zeros and problem.chain is not None:
        layout = replace(problem.layout, links=())
        bare = replace(problem, layout=layout, fixed=replace(problem.fixed, links=np.zeros(0)))
        bare_state = replace(state, links=np.zeros(0))
        drawn = predict_rows(bare, bare_state, draw_joints(problem.chain, _DRAWN_ROWS, seed=0))
        jacobian = whitened_jacobian(drawn, bare_state, _NOISE)
        full, right = _right_singular(jacobian * natural_sizes(layout))
        null = right[full <= STRUCTURAL * full.max()]
        place = layout.blocks["joint_zeros"]
        shares = np.sum(null[:, place] ** 2, axis=0)
        if len(null) == 0 or shares.max(initial=0.0) < AFFECTED**2:
            break
        at = int(np.argmax(shares))
        direction = null.T @ null[:, place.start + at]
        joint = layout.zeros[at]
        others = [
            part
            for part in describe_direction(problem, layout, direction)
            if part != _zero(layout.joints[joint])
        ]
        found.append(
            Gauge(
                joint,
                f"the {_zero(layout.joints[joint])} and {' and '.join(others)} cannot be "
                "distinguished in any poses; the zero keeps its nominal value, and the other "
                "estimate contains both",
            )
        )
        problem = replace(problem, layout=problem.layout.without_zeros({joint}))
    return problem, tuple(found)


@dataclass(frozen=True)
class Direction:
    """A direction of the unknowns that the observations do not determine.

    Attributes:
        weights: (count,) unit vector in rad and m.
        words: a sentence for people.
    """

    weights: FloatArray
    words: str


def undetermined_directions(fit: Fit) -> tuple[Direction, ...]:
    """Return directions of the unknowns that a fit's observations and priors do not determine."""
    layout = fit.problem.layout
    if layout.count == 0:
        return ()
    noise = {
        name: float(np.clip(size, UNSEEN_ERROR.get(name, 0.0), LARGEST_NOISE.get(name, np.inf)))
        for name, size in fit.noise.items()
    }
    natural = natural_sizes(layout, _lever(noise))
    jacobian = whitened_jacobian(fit.problem, fit.state, noise, fit.kept)
    full, right = _right_singular(jacobian * natural)
    rows = max(len({int(r) for t in fit.problem.terms for r in t.rows}), 1)
    has_poses = "rotation" in fit.noise
    # Noise that is estimated from few residuals may be larger.
    doubt = float(student.ppf(0.975, max(fit.degrees, 1.0)) / norm.ppf(0.975))
    least = np.full(layout.count, doubt / UNDETERMINED_RAD)
    if has_poses:
        # Information from the priors is not caused by noise.
        priors = sum(parameter.prior is not None for parameter in layout.parameters)
        designed = jacobian[len(jacobian) - priors :] * natural @ right.T
        measured = np.sum(designed**2, axis=0) < full**2 / 2.0
        least[measured] = np.maximum(least, FEIGNED_FACTOR * np.sqrt(rows))[measured]
    null = right[(full < least) | (full <= STRUCTURAL * full.max())]
    found = []
    turning = np.array([parameter.unit == "rad" for parameter in layout.parameters])
    for direction in _sparse_basis(null, turning):
        words = describe_direction(fit.problem, layout, direction)
        apart = (
            f"{' and '.join(words)} cannot be distinguished in these poses"
            if len(words) > 1
            else f"{words[0]} is not determined by these poses"
        )
        found.append(Direction(direction, apart))
    return tuple(found)


def uncertain_directions(
    fit: Fit, covariance: FloatArray, quantile: float
) -> tuple[Direction, ...]:
    """Return directions that make predictions in the workspace far worse than the plan accepts.

    Nearly equal poses predict each other well even with wrong unknowns.

    Args:
        covariance: (count, count) covariance of the unknowns, m and rad.
        quantile: half width of a 95 % interval in standard deviations.
    """
    problem, accept = fit.problem, fit.problem.plan.accept
    if problem.layout.count == 0:
        return ()
    if problem.chain is not None:
        at = draw_joints(problem.chain, _DRAWN_ROWS, seed=1)
    else:
        assert problem.observations.flange is not None
        at = draw_flanges(problem.observations.flange, _DRAWN_ROWS, seed=1)
    found = spread(problem, fit.state, covariance, at)
    directions = []
    for kind, bound, unit in (
        ("translation", accept.translation, "mm"),
        ("rotation", accept.rotation, "mrad"),
    ):
        width = quantile * found.sizes.get(kind, 0.0)
        if bound is None or width <= FAR_WIDER * norm.ppf(0.975) * bound:
            continue
        worst = found.worst[kind]
        parts = describe_direction(problem, problem.layout, worst)
        directions.append(
            Direction(
                worst / np.linalg.norm(worst),
                f"{parts[0]}: known so poorly that in other poses of the workspace predictions "
                f"are off by up to {1e3 * width:.2g} {unit} (95 %), {1e3 * bound:.2g} {unit} are "
                "accepted; turn the flange further, about several axes",
            )
        )
    return tuple(directions)


def untested_directions(fit: Fit, held: CalibrationProblem) -> tuple[str, ...]:
    """Return the directions of the frames that held-out observations alone do not test.

    Held-out poses that rotate about one axis are predicted equally well by a camera that is
    elsewhere along this axis. Joint zeros, links and the size of the target keep their estimates.

    Args:
        held: the problem on the held-out observations.
    """
    rows = {int(row) for term in held.terms for row in term.rows}
    if len(rows) < FEWEST_HELD_OUT:
        return ()
    state = replace(fit.state, links=np.zeros(0))
    layout = replace(fit.problem.layout, zeros=(), links=(), scale=False)
    frames = replace(held, layout=layout, fixed=replace(held.fixed, links=np.zeros(0)))
    everything = tuple(np.ones(len(term.rows), dtype=bool) for term in frames.terms)
    only_held = replace(fit, problem=frames, state=state, kept=everything)
    return tuple(direction.words for direction in undetermined_directions(only_held))


def affected_unknowns(layout: Layout, directions: Sequence[Direction]) -> np.ndarray:
    """(count,) True for the unknowns that belong to a direction."""
    parts = np.zeros(layout.count, dtype=bool)
    for direction in directions:
        sizes = np.abs(direction.weights)
        parts |= sizes > AFFECTED * sizes.max()
    return parts


def _right_singular(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(columns,) singular values, padded with zeros if rows are too few, and all right vectors."""
    missing = max(matrix.shape[1] - matrix.shape[0], 0)
    padded = np.vstack([matrix, np.zeros((missing, matrix.shape[1]))])
    _, singular, right = np.linalg.svd(padded, full_matrices=False)
    return np.asarray(singular), np.asarray(right)


def _lever(noise: Mapping[str, float]) -> float:
    """Length at which the noise of an angle is as large as that of a position, m."""
    if "rotation" not in noise or "translation" not in noise:
        return 1.0
    return float(np.clip(noise["translation"] / noise["rotation"], UNDETERMINED_M, 1.0))


def natural_sizes(layout: Layout, length: float = 1.0) -> FloatArray:
    """(count,) scale of each unknown: 1 rad, a factor of 1, or ``length`` in m."""
    return np.array([length if p.unit == "m" else 1.0 for p in layout.parameters])


def _sparse_basis(null: FloatArray, turning: np.ndarray) -> list[FloatArray]:
    """Return a sparse basis of a null space (Gauss-Jordan).

    Angles are eliminated first: a shift along an axis is then apart from the turn about it.

    Args:
        turning: (columns,) True for angles.
    """
    rows = null.copy()
    for at in range(len(rows)):
        left = np.abs(rows[at:])
        angles = np.where(turning, left, 0.0)
        if angles.max(initial=0.0) > AFFECTED * left.max():
            left = angles
        source, pivot = divmod(int(np.argmax(left)), left.shape[1])
        order = np.arange(len(rows))
        order[at], order[at + source] = at + source, at
        rows = rows[order]
        rows[at] /= rows[at, pivot]
        for other in range(len(rows)):
            if other != at:
                rows[other] -= rows[other, pivot] * rows[at]
    return [row / np.linalg.norm(row) for row in rows if np.linalg.norm(row) > 1e-12]


def describe_direction(
    problem: CalibrationProblem, layout: Layout, direction: FloatArray
) -> list[str]:
    """Describe the components of a direction, the largest first."""
    size = float(np.abs(direction).max())
    found: list[tuple[float, str]] = []
    for block, place in layout.blocks.items():
        values = direction[place]
        kind, _, name = block.partition(":")
        if np.abs(values).max() <= AFFECTED * size:
            continue
        if kind == "pose":
            what = describe_pose(name, problem.plan.mount)
            for part, of in ((values[3:], "the rotation"), (values[:3], "the position")):
                share = float(np.linalg.norm(part))
                if share > AFFECTED * size:
                    found.append((share, f"{of} of {what} {_axis(part, of)}"))
                    # A rotation about an axis off the origin moves the origin too.
                    break
        elif kind == "point":
            along = _axis(values, "the position")
            what = f"the position of {_point(name)} {along}"
            found.append((float(np.linalg.norm(values)), what))
        elif kind == "scale":
            found.append((abs(float(values[0])), "the scale of the camera's positions"))
        else:
            for value, parameter in zip(values, layout.parameters[place], strict=True):
                if abs(value) > AFFECTED * size:
                    zero = kind == "joint_zeros"
                    label = _zero(parameter.label) if zero else parameter.label
                    found.append((abs(float(value)), label))
    return [words for _, words in sorted(found, key=lambda item: -round(item[0], 2))]


def _zero(joint: str) -> str:
    return f"zero of {joint}"


def _point(name: str) -> str:
    if name == TIP:
        return "the tool's tip"
    return "the fixed point" if name.startswith(PIVOT) else f"marker {marker_of(name)!r}"


def _axis(part: FloatArray, of: str) -> str:
    """Describe an axis: ``about its z (roll)``, ``along x``, or as a vector."""
    unit = part / np.linalg.norm(part)
    largest = int(np.argmax(np.abs(unit)))
    turning = of == "the rotation"
    word = "about its" if turning else "along"
    if abs(unit[largest]) > 0.98:
        name = POSE_LABELS[largest]
        return f"{word} {name} axis" + (" (roll)" if turning and name == "z" else "")
    unit = unit * np.sign(unit[largest])
    return f"{word} axis ({', '.join(f'{value:.2f}' for value in unit)})"
