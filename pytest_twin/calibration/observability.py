"""Which directions of the unknowns the observations determine, and which they do not, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import POSE_LABELS, Layout, State
from pytest_twin.calibration.problem import PIVOT, TIP, Problem, marker_of, words_of
from pytest_twin.calibration.solve import Fit, whitened_jacobian
from pytest_twin.calibration.workspace import drawn_flanges, drawn_joints, predicted_rows, spread

UNDETERMINED_RAD = 0.05
"""Standard deviation beyond which an angle counts as not determined: no robot task can use it."""

UNDETERMINED_M = 0.05
"""The same for a position."""

FEIGNED_FACTOR = 3.0
"""The noise of n poses alone adds n to the information about a direction that they do not excite
(Lu, Zhang, Xue: errors in variables). Information below the square of this factor times n is no
evidence."""

UNSEEN_ERROR = {"translation": 1e-4, "rotation": 1e-3, "point": 1e-3}
"""Errors that residuals do not show where all poses are alike, m and rad: an arm's zeros, its
bending and a camera's distortion are then the same in each. A good arm has 1 mrad and 1 mm; of the
position of a target in a camera 0.1 mm. Information is counted against at least these."""

LARGEST_NOISE = {"translation": 0.003, "rotation": 0.01, "point": 0.003}
"""Noise that counts at most, m and rad: larger residuals come from a wrong model or wrong input and
say nothing about the poses."""

FAR_WIDER = 3.0
"""The unknowns count as not determined where their uncertainty alone predicts other poses of the
workspace this many times worse than the plan accepts. Poses in a part of the workspace, tilted by
20 degrees, predict the rest twice as badly as themselves."""

STRUCTURAL = 1e-7
"""Singular values below this part of the largest are zero up to rounding."""

AFFECTED = 0.02
"""A coordinate takes part in a direction from this part of the direction's largest component on.
Rounding leaves 1e-6."""

_DRAWN_ROWS = 60
_NOISE = {"translation": 1e-3, "rotation": 1e-3, "point": 1e-3, "pixel": 1.0}


@dataclass(frozen=True)
class Gauge:
    """A joint's zero that another unknown can always replace, and that is therefore held.

    Attributes:
        joint: index of the joint.
        words: a sentence for people.
    """

    joint: int
    words: str


def hold_gauges(problem: Problem, state: State) -> tuple[Problem, tuple[Gauge, ...]]:
    """The problem with the zeros held that no poses whatever could determine.

    A free base turns like the first joint, and a free camera on the flange like the last one. The
    structure is looked at in drawn joint positions, so that poses that are merely alike do not
    count here.
    """
    found: list[Gauge] = []
    while problem.layout.zeros and problem.chain is not None:
        layout = replace(problem.layout, links=())
        bare = replace(problem, layout=layout, fixed=replace(problem.fixed, links=np.zeros(0)))
        bare_state = replace(state, links=np.zeros(0))
        drawn = predicted_rows(bare, bare_state, drawn_joints(problem.chain, _DRAWN_ROWS, seed=0))
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
            for part in parts_in_words(problem, layout, direction)
            if part != _zero(layout.joints[joint])
        ]
        found.append(
            Gauge(
                joint,
                f"the {_zero(layout.joints[joint])} and {' and '.join(others)} cannot be told "
                "apart in any poses; the zero is held at its nominal value and the other takes "
                "it up",
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


def undetermined(fit: Fit) -> tuple[Direction, ...]:
    """Directions of the unknowns that a fit's observations and priors do not determine."""
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
    # A noise that few residuals tell may be larger.
    doubt = float(student.ppf(0.975, max(fit.degrees, 1.0)) / norm.ppf(0.975))
    least = np.full(layout.count, doubt / UNDETERMINED_RAD)
    if has_poses:
        # What the design states is no information that noise feigns.
        priors = sum(parameter.prior is not None for parameter in layout.parameters)
        designed = jacobian[len(jacobian) - priors :] * natural @ right.T
        measured = np.sum(designed**2, axis=0) < full**2 / 2.0
        least[measured] = np.maximum(least, FEIGNED_FACTOR * np.sqrt(rows))[measured]
    null = right[(full < least) | (full <= STRUCTURAL * full.max())]
    found = []
    for direction in _simple(null):
        words = parts_in_words(fit.problem, layout, direction)
        apart = (
            f"{' and '.join(words)} cannot be distinguished in these poses"
            if len(words) > 1
            else f"{words[0]} is not determined by these poses"
        )
        found.append(Direction(direction, apart))
    return tuple(found)


def unsure(fit: Fit, covariance: FloatArray, quantile: float) -> tuple[Direction, ...]:
    """Directions that make predictions in the workspace far worse than the plan accepts.

    Poses that are nearly alike predict one another well whatever the unknowns are.

    Args:
        covariance: (count, count) of the unknowns, m and rad.
        quantile: half width of a 95 % interval in standard deviations.
    """
    problem, accept = fit.problem, fit.problem.plan.accept
    if problem.layout.count == 0:
        return ()
    if problem.chain is not None:
        at = drawn_joints(problem.chain, _DRAWN_ROWS, seed=1)
    else:
        assert problem.observations.flange is not None
        at = drawn_flanges(problem.observations.flange, _DRAWN_ROWS, seed=1)
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
        parts = parts_in_words(problem, problem.layout, worst)
        directions.append(
            Direction(
                worst / np.linalg.norm(worst),
                f"{parts[0]}: known so poorly that in other poses of the workspace predictions "
                f"are off by up to {1e3 * width:.2g} {unit} (95 %), {1e3 * bound:.2g} {unit} are "
                "accepted; turn the flange further, about several axes",
            )
        )
    return tuple(directions)


def affected(layout: Layout, directions: Sequence[Direction]) -> np.ndarray:
    """(count,) True for the unknowns that take part in a direction."""
    parts = np.zeros(layout.count, dtype=bool)
    for direction in directions:
        sizes = np.abs(direction.weights)
        parts |= sizes > AFFECTED * sizes.max()
    return parts


def _right_singular(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(columns,) singular values, zero where rows are too few, and all their right vectors."""
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
    """(count,) size of each unknown that counts alike: 1 rad, a factor of 1, and a length in m."""
    return np.array([length if p.unit == "m" else 1.0 for p in layout.parameters])


def _simple(null: FloatArray) -> list[FloatArray]:
    """A basis of a null space in which each direction has few parts (Gauss-Jordan)."""
    rows = null.copy()
    for at in range(len(rows)):
        pivot = int(np.argmax(np.abs(rows[at])))
        rows[at] /= rows[at, pivot]
        for other in range(len(rows)):
            if other != at:
                rows[other] -= rows[other, pivot] * rows[at]
    return [row / np.linalg.norm(row) for row in rows if np.linalg.norm(row) > 1e-12]


def parts_in_words(problem: Problem, layout: Layout, direction: FloatArray) -> list[str]:
    """What takes part in a direction, the largest part first."""
    size = float(np.abs(direction).max())
    found: list[tuple[float, str]] = []
    for block, place in layout.blocks.items():
        values = direction[place]
        kind, _, name = block.partition(":")
        if np.abs(values).max() <= AFFECTED * size:
            continue
        if kind == "pose":
            what = words_of(name, problem.plan.mount)
            for part, of in ((values[3:], "the rotation"), (values[:3], "the position")):
                share = float(np.linalg.norm(part))
                if share > AFFECTED * size:
                    found.append((share, f"{of} of {what} {_axis(part, of)}"))
                    # A turn about an axis beside the origin moves the origin too.
                    break
        elif kind == "point":
            found.append((float(np.linalg.norm(values)), f"the position of {_point(name)}"))
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
    """``about its z (roll)``, ``along x``; a direction where it is none of the axes."""
    unit = part / np.linalg.norm(part)
    largest = int(np.argmax(np.abs(unit)))
    turning = of == "the rotation"
    word = "about its" if turning else "along"
    if abs(unit[largest]) > 0.98:
        name = POSE_LABELS[largest]
        return f"{word} {name} axis" + (" (roll)" if turning and name == "z" else "")
    unit = unit * np.sign(unit[largest])
    return f"{word} axis ({', '.join(f'{value:.2f}' for value in unit)})"
