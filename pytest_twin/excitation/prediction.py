"""Predict the parameters that each motion determines, and their standard deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.friction import LoadDependentFriction
from pytest_twin.effects.transmission import Backlash
from pytest_twin.estimation.covariance import predicted_covariance
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.closed_loop import Response
from pytest_twin.excitation.gravity_grid import SETTLE, random_poses, static_matrix
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.noise import SampleNoise
from pytest_twin.identification.regressor.base_parameters import BaseParameters, base_of
from pytest_twin.identification.regressor.columns import drive_effects
from pytest_twin.identification.regressor.regressor import Regressor

SMALL_EFFORT = 0.01
"""Share of the approved effort below which dry friction, constant efforts, and viscous friction at
the approved speed count as small."""
SMALL_INERTIA = 0.1
"""Share of the largest moment of equal order of a link below which its moments count as small. A
product of inertia with nominal value 0 is determined if its interval shows that it is small."""
_TWO_SIDED = 1.96
"""Half width of a 95 % interval in standard deviations."""
_STATED = 1e-6
"""Share of the robot's largest moment below which a link's moments count as unstated."""
_ROUNDING = 1e-6
"""Fraction of the resolution below which a nominal value is a rounding error."""
LOADS_APART = 0.02
"""Smallest difference of loads that separates load-dependent friction, as a share of the approved
effort."""


@dataclass(frozen=True, slots=True)
class PredictedAccuracy:
    """Predicted accuracy of one parameter.

    Attributes:
        name: name, ``JOINT.KIND``.
        expression: expression in the symbols of the literature, or the name.
        unit: unit of value and deviation.
        nominal: the model's value, or None.
        std: predicted standard deviation; infinite if the motion does not determine it.
        resolution: value below which its effect is small.
        why: reason why it is not determined, or empty.
    """

    mechanism: str
    name: str
    expression: str
    words: str
    unit: str
    nominal: float | None
    std: float
    resolution: float = 0.0
    why: str = ""

    @property
    def is_identifiable(self) -> bool:
        """Whether the 95 % interval excludes 0, or contains only values of small effect."""
        if not math.isfinite(self.std):
            return False
        reach = max(abs(self.nominal or 0.0), self.resolution)
        return self.nominal is None or _TWO_SIDED * self.std <= reach

    @property
    def is_small(self) -> bool:
        """Whether the nominal value has a small effect."""
        return self.nominal is not None and abs(self.nominal) <= self.resolution

    @property
    def relative_std(self) -> float | None:
        """Return deviation divided by nominal value; None if that is 0 or unknown."""
        return self.std / abs(self.nominal) if self.nominal else None


def of_base(
    mechanism: str,
    base: BaseParameters,
    regressor: Regressor,
    matrix: FloatArray,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict base parameters from the full regressor along motions.

    Args:
        regressor: regressor of the approved joints.
        matrix: (n, joints, p) regressor at each measured instant.
    """
    own = base.matrix(matrix)
    predicted = predicted_covariance(own, noise.effort)
    nominal = base.values(regressor.prior)
    resolution = _small(base, nominal, approved)
    # Cancellation leaves rounding errors.
    nominal = np.where(np.abs(nominal) < _ROUNDING * resolution, 0.0, nominal)
    return [
        PredictedAccuracy(
            mechanism,
            name,
            expression,
            words,
            unit,
            float(nominal[at]),
            float(predicted.std[at]),
            float(resolution[at]),
            "not separable from the others by this motion" if predicted.undetermined[at] else "",
        )
        for at, (name, expression, words, unit) in enumerate(
            zip(base.names, base.expressions, base.words, base.units, strict=True)
        )
    ]


def _small(base: BaseParameters, nominal: FloatArray, approved: ApprovedLimits) -> FloatArray:
    """Return the (b,) values below which each parameter's effect is small, in its unit."""
    limits = {joint.name: joint for joint in approved.joints}
    kinds = [base.columns[index] for index in base.independent]
    sizes: dict[str, dict[str, float]] = {}
    for column, value in zip(kinds, nominal.tolist(), strict=True):
        of_unit = sizes.setdefault(column.unit, {})
        of_unit[column.joint] = max(abs(value), of_unit.get(column.joint, 0.0))
    found = np.zeros(len(base))
    for at, column in enumerate(kinds):
        joint = limits.get(column.joint)
        power = None if column.is_inertial else _speed_power(column.kind)
        if power is not None and joint is not None:
            found[at] = SMALL_EFFORT * joint.effort / joint.velocity**power
        else:
            links = sizes[column.unit]
            stated = _STATED * max(links.values())
            # A link without moments in the model gets the scale of the smallest link with moments.
            least = min((size for size in links.values() if size > stated), default=0.0)
            found[at] = SMALL_INERTIA * max(links[column.joint], least)
    return found


def _speed_power(kind: str) -> int | None:
    """Return the power of the speed to which the effort of a drive's parameter is proportional."""
    effect = catalogue().get(kind)
    if effect is None:
        return None
    return {"effort": 0, "damping": 1, "drag": 2}.get(effect.parameters[0].quantity)


def inertia(
    motions: Sequence[Motion],
    base: BaseParameters,
    regressor: Regressor,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict all base parameters with friction, from Fourier series."""
    matrix = np.concatenate(
        [regressor.matrix(m.position, m.velocity, m.acceleration) for m in motions]
    )
    return of_base("inertia", base, regressor, matrix, approved, noise)


def gravity(
    motion: Motion,
    base: BaseParameters,
    regressor: Regressor,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict static base parameters, from poses at rest."""
    still = at_rest(motion, approved.rate)
    matrix = regressor.matrix(
        motion.position[still],
        np.zeros_like(motion.position[still]),
        np.zeros_like(motion.position[still]),
    )
    return of_base("gravity", base, regressor, matrix, approved, noise)


def at_rest(motion: Motion, rate: float) -> NDArray[np.intp]:
    """Return indices of samples at rest for longer than ``SETTLE``, including both ends."""
    resting = np.all(motion.velocity == 0.0, axis=1) & np.all(motion.acceleration == 0.0, axis=1)
    count = max(1, round(SETTLE * rate))
    settled = resting.copy()
    for back in range(1, count + 1):
        settled[back:] &= resting[:-back]
    return np.flatnonzero(settled)


def friction(
    motions: Sequence[Motion],
    joint: int,
    regressor: Regressor,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict viscous, Coulomb and load-dependent friction of a joint, from reversals under loads.

    The joint's other base parameters are fitted at the same time.
    """
    limits = approved.joints[joint]
    rows, loads = [], []
    for motion in motions:
        moving = motion.velocity[:, joint] != 0.0
        moving &= np.all(np.delete(motion.velocity, joint, axis=1) == 0.0, axis=1)
        states = (motion.position[moving], motion.velocity[moving], motion.acceleration[moving])
        rows.append(regressor.matrix(*states)[:, joint : joint + 1])
        still = static_matrix(regressor, states[0])[:, joint] @ regressor.prior
        loads.append(np.abs(still) * np.sign(states[1][:, joint]))
    matrix, load = np.concatenate(rows), np.concatenate(loads)
    base = base_of(matrix, regressor.columns)
    own = base.matrix(matrix)
    most = float(np.abs(load).max(initial=0.0))
    spread = float(np.ptp(np.abs(load))) if len(load) else 0.0
    separate = spread > LOADS_APART * limits.effort
    if separate:
        own = np.concatenate([own, load[:, None, None]], axis=2)
    std = predicted_covariance(own, noise.effort[joint : joint + 1]).std
    nominal = base.values(regressor.prior)
    small = _small(base, nominal, approved)
    found = []
    for effect in drive_effects():
        if effect.family != "friction":
            continue
        name = f"{limits.name}.{effect.id}"
        words = f"{effect.parameters[0].meaning} of '{limits.name}'"
        if name not in base.names:
            found.append(_open("friction", name, words, "not separable from others by this motion"))
            continue
        at = base.names.index(name)
        found.append(
            PredictedAccuracy(
                "friction", name, base.expressions[at], words, base.units[at],
                float(nominal[at]), float(std[at]), float(small[at]),
            )
        )  # fmt: skip
    name = f"{limits.name}.{LoadDependentFriction.id}"
    words = f"load-dependent friction of '{limits.name}'"
    if separate:
        found.append(PredictedAccuracy("friction", name, name, words, "1", None, float(std[-1])))
    elif most > LOADS_APART * limits.effort:
        found.append(
            _open(
                "friction", name, words,
                f"the load of the joint changes by {spread:.3g} {limits.effort_unit} only; declare "
                "payloads: in twin.yaml, or approve a wider range of the other joints",
            )
        )  # fmt: skip
    # Without load on the joint there is no load-dependent friction.
    return found


def backlash(
    motions: Sequence[Motion], joint: int, approved: ApprovedLimits, noise: SampleNoise
) -> PredictedAccuracy:
    """Predict backlash: the position's hysteresis between both directions, on the joint side."""
    limits = approved.joints[joint]
    moving = sum(int((motion.velocity[:, joint] != 0.0).sum()) for motion in motions)
    std = 2.0 * float(noise.position[joint]) / math.sqrt(max(moving, 1))
    name = f"{limits.name}.{Backlash.id}"
    words = f"backlash of '{limits.name}', if its encoder is on the joint side of the gear"
    return PredictedAccuracy("backlash", name, name, words, limits.unit, None, std)


def delay(
    responses: Sequence[Response], joint: int, approved: ApprovedLimits, noise: SampleNoise
) -> PredictedAccuracy:
    """Predict the delay of a joint's motion from its speed: std = noise / sqrt(sum v^2)."""
    limits = approved.joints[joint]
    energy = sum(float((one.velocity[:, joint] ** 2).sum()) for one in responses)
    name, words = f"{limits.name}.delay", f"delay of '{limits.name}'"
    if not energy > 0.0:
        return _open("delay", name, words, "the joint does not move")
    std = float(noise.position[joint]) / math.sqrt(energy)
    return PredictedAccuracy("delay", name, name, words, "s", None, std)


def closed_loop(
    response: Response,
    gains: Mapping[str, tuple[float, str, FloatArray]],
    joint: int,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict the gains of one joint's servo, fitted together with its delay.

    Args:
        response: response of the nominal model.
        gains: result of :meth:`ClosedLoop.servo_derivatives`.
    """
    limits = approved.joints[joint]
    if not gains:
        name = f"{limits.name}.closed_loop"
        words = f"closed loop of '{limits.name}'"
        why = "the model has no position servo with linear gains here, so nothing can be predicted"
        return [_open("closed_loop", name, words, why)]
    columns = [derivative for _, _, derivative in gains.values()]
    matrix = np.stack([*columns, -response.velocity[:, joint]], axis=1)
    std = predicted_covariance(matrix[:, None], noise.position[joint : joint + 1]).std
    return [
        PredictedAccuracy(
            "closed_loop", f"{limits.name}.servo_{name}", f"{limits.name}.servo_{name}",
            f"{name} of the servo of '{limits.name}'", unit, value, float(std[at]),
        )
        for at, (name, (value, unit, _)) in enumerate(gains.items())
    ]  # fmt: skip


def payload(
    motion: Motion,
    carrier: str,
    regressor: Regressor,
    approved: ApprovedLimits,
    noise: SampleNoise,
) -> list[PredictedAccuracy]:
    """Predict mass and first moments of a payload, from equal poses with and without it.

    A parameter without influence on the effort at any pose is omitted.

    Args:
        carrier: joint that moves the link with the payload.
        regressor: regressor of the approved joints.
    """
    places = [
        at
        for at, column in enumerate(regressor.columns)
        if column.joint == carrier and column.kind in ("mx", "my", "mz", "m")
    ]
    columns = [regressor.columns[at] for at in places]
    own = base_of(static_matrix(regressor, random_poses(regressor, approved))[..., places], columns)
    poses = motion.position[at_rest(motion, approved.rate)]
    matrix = own.matrix(static_matrix(regressor, poses)[..., places])
    # The difference of two measurements has twice the variance.
    predicted = predicted_covariance(matrix, math.sqrt(2.0) * noise.effort)
    found = []
    for at, index in enumerate(own.independent):
        name = f"payload.{columns[index].kind}"
        words = f"{columns[index].words.partition(' of the link')[0]} of the payload on '{carrier}'"
        if predicted.undetermined[at]:
            found.append(
                _open("payload", name, words, "not separable from the others by these poses")
            )
            continue
        found.append(
            PredictedAccuracy(
                "payload", name, own.expressions[at], words, columns[index].unit, None,
                float(predicted.std[at]),
            )
        )  # fmt: skip
    return found


def _open(mechanism: str, name: str, words: str, why: str) -> PredictedAccuracy:
    return PredictedAccuracy(mechanism, name, name, words, "", 0.0, math.inf, why=why)
