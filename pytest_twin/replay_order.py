"""Test the assumed order of joints that a recording does not name, by replays in other orders."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.open_loop import Replayed, replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial
from pytest_twin.words import list_names

# s of each replay.
_SECONDS = 5.0
# More joints have too many orders; then only the likely ones are tested.
_MOST_JOINTS = 7
# The best order has less than this fraction of the assumed order's mean square error.
_MUCH_BETTER = 0.5
# rad or m. Joints that move less do not show their order.
_MOVED = 0.02


def refuse_other_order(realization: Realization, trials: Sequence[Trial]) -> None:
    """Check that no other order of unnamed joints predicts the motion much better.

    The first recording of each assumed order is tested: the others were made by the same node.

    Raises:
        RecordingError: another order predicts it much better. Estimates would be of other joints.
    """
    first = {(trial.joints, trial.unnamed): trial for trial in reversed(trials) if trial.unnamed}
    for trial in first.values():
        better = _better_order(realization, trial)
        if better is not None:
            raise RecordingError(
                "the joints are not named, and may be in another order",
                path=trial.path,
                value=_doubt(trial, better),
                expected=f"--joints {_mapping(better.order)}, or in the assumed order --joints "
                f"{_mapping(trial.joints)}, or 'joints:' in twin.yaml",
            )


def doubt_of_order(realization: Realization, trial: Trial) -> str | None:
    """Return a note if another order of unnamed joints predicts the motion much better.

    Tested are the alphabetical order, which ``joint_state_broadcaster`` uses, the reverse, and for
    few joints every exchange of two.

    Args:
        trial: a trial whose joints have the order of the model's actuators.
    """
    better = _better_order(realization, trial)
    if better is None:
        return None
    return f"{_doubt(trial, better)}; --joints {_mapping(better.order)} or 'joints:' in twin.yaml"


@dataclass(frozen=True)
class _BetterOrder:
    """An order of joints, and its RMS error relative to that of the assumed order."""

    order: tuple[str, ...]
    error_ratio: float


def _better_order(realization: Realization, trial: Trial) -> _BetterOrder | None:
    if not trial.unnamed or len(trial.time) < 2:
        return None
    short = trial.until(_SECONDS)
    orders = _orders(trial.joints)
    results = replay(realization, [_in_order(short, order) for order in orders])
    errors = [_error(result) for result in results]
    best = int(np.argmin(errors))
    if not errors[best] < _MUCH_BETTER * errors[0]:
        return None
    return _BetterOrder(orders[best], float(np.sqrt(errors[best] / errors[0])))


def _doubt(trial: Trial, better: _BetterOrder) -> str:
    return (
        f"the order of the joints may be {list_names(better.order)}: it predicts the motion with "
        f"{100 * better.error_ratio:.2g} % of the error of the assumed order "
        f"{list_names(trial.joints)}"
    )


def _mapping(order: Sequence[str]) -> str:
    return ",".join(f"{at}={joint}" for at, joint in enumerate(order))


def _orders(joints: tuple[str, ...]) -> list[tuple[str, ...]]:
    """The assumed order, and others to test."""
    orders = [joints, tuple(sorted(joints)), joints[::-1]]
    if len(joints) <= _MOST_JOINTS:
        for first, second in itertools.combinations(range(len(joints)), 2):
            order = list(joints)
            order[first], order[second] = order[second], order[first]
            orders.append(tuple(order))
    return list(dict.fromkeys(orders))


def _in_order(trial: Trial, order: Sequence[str]) -> Trial:
    """The trial with its unnamed columns in another order."""
    names = dict(zip(trial.joints, order, strict=True))
    if "state" in trial.unnamed:
        trial = replace(trial, joints=tuple(names[joint] for joint in trial.joints))
    if "command" in trial.unnamed:
        commands = tuple(names.get(joint, joint) for joint in trial.command_joints)
        trial = replace(trial, command_joints=commands)
    return trial


def _error(result: Replayed) -> float:
    """Sum over the joints of the mean square error, relative to the joint's motion."""
    if result.error is not None:
        return float("inf")
    total = 0.0
    for predicted, measured in zip(result.position.T, result.trial.position.T, strict=True):
        seen = np.isfinite(measured)
        motion = float(np.var(measured[seen])) + _MOVED**2
        total += float(np.mean((predicted[seen] - measured[seen]) ** 2)) / motion
    return total
