"""Choose the motions for the requested mechanisms."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation import d_optimal, single_joint
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.gravity_grid import grid, static_matrix
from pytest_twin.excitation.motion import Design, JointStates, Role
from pytest_twin.excitation.prediction import LOADS_APART
from pytest_twin.identification.regressor.regressor import Regressor

ROLES: tuple[Role, ...] = ("fit", "held_out")
_POSES = 60
"""Number of random poses from which the smallest and largest load of a joint are chosen."""


def single_joint_designs(
    approved: ApprovedLimits, loads: Sequence[Sequence[FloatArray]], seed: int
) -> list[Design]:
    """Return designs of steps, chirps and reversals of each joint.

    Args:
        loads: for each joint, poses (j,) with different loads on it.
        seed: seed of all random choices.
    """
    asked, found = set(approved.mechanisms), []
    for joint, limits in enumerate(approved.joints):
        for role in ROLES:
            own = _seed(seed, role, joint)
            parts: list[tuple[str, tuple[str, ...], str, Callable[[float, int], JointStates]]] = []
            if "delay" in asked:
                parts.append(("steps", ("delay",), "", single_joint.steps(approved, joint)))
            if "closed_loop" in asked:
                parts.append(
                    ("chirp", ("closed_loop",), "", single_joint.chirp(approved, joint, role))
                )
            slow = tuple(one for one in ("friction", "backlash") if one in asked)
            if slow:
                for number, pose in enumerate(loads[joint], 1):
                    make = single_joint.reversals(approved, joint, pose, role)
                    parts.append(("reversals", slow, f"_load{number}", make))
            found += [
                Design(
                    f"{kind}_{limits.name}{which}_{role}",
                    mechanisms, kind, role, (limits.name,), make, own,
                )
                for kind, mechanisms, which, make in parts
            ]  # fmt: skip
    return found


def several_joint_designs(
    approved: ApprovedLimits,
    regressor: Regressor,
    std: FloatArray,
    around: ClearanceChecker,
    payloads: Sequence[str],
    optimal: d_optimal.Design | None,
    seed: int,
) -> list[Design]:
    """Return designs of the static grid, once for each payload, and the Fourier series.

    Args:
        std: (joints,) standard deviation of the effort's noise, N*m or N.
        optimal: design of the series; None if not requested.
        seed: seed of all random choices.
    """
    asked, found = set(approved.mechanisms), []
    static = tuple(one for one in ("gravity", "payload") if one in asked)
    for role in ROLES:
        own = _seed(seed, role, len(approved.joints))
        if static:
            make = grid(approved, regressor, std, around.is_clear)
            found.append(Design(f"grid_{role}", static, "grid", role, approved.names, make, own))
            if "payload" in asked:
                found += [
                    Design(
                        f"grid_payload_{name}_{role}", ("payload",), "grid", role,
                        approved.names, make, own, name,
                    )
                    for name in payloads
                ]  # fmt: skip
        if optimal is not None:
            # Held-out motion has to differ within the same limits; it need not be optimal.
            starts = d_optimal.STARTS if role == "fit" else 1
            series = _series(optimal, starts)
            found.append(
                Design(
                    f"fourier_{role}", ("inertia",), "fourier", role, approved.names, series, own
                )
            )
    return found


def loading_poses(
    approved: ApprovedLimits,
    regressor: Regressor,
    is_clear: Callable[[FloatArray], bool],
    seed: int,
) -> list[list[FloatArray]]:
    """Return for each joint the poses of the others that load it least and most.

    The start is returned if they do not affect the load. The joint itself is in the middle of its
    range, where reversals have the largest amplitude.
    """
    random = np.random.default_rng(seed)
    lower, upper = approved.room
    found = []
    for joint, limits in enumerate(approved.joints):
        poses = random.uniform(lower, upper, (_POSES, len(approved.joints)))
        poses[0] = approved.start
        poses[:, joint] = 0.5 * (lower[joint] + upper[joint])
        efforts = static_matrix(regressor, poses)[:, joint] @ regressor.prior
        order = np.argsort(efforts)
        least = next((i for i in order if is_clear(poses[i])), None)
        most = next((i for i in order[::-1] if is_clear(poses[i])), None)
        if least is None or most is None:
            found.append([approved.start])
        elif efforts[most] - efforts[least] < LOADS_APART * limits.effort:
            found.append([poses[0] if is_clear(poses[0]) else approved.start])
        else:
            found.append([poses[least], poses[most]])
    return found


def _series(design: d_optimal.Design, starts: int) -> Callable[[float, int], JointStates]:
    known: dict[int, d_optimal.Optimum] = {}

    def make(scale: float, seed: int) -> JointStates:
        if seed not in known:
            known[seed] = design.optimum(seed, starts)
        return design.drawn(known[seed].coefficients, scale).described(
            frequencies=design.series.frequencies.tolist(),
            period=design.series.period,
            centre=design.centre.tolist(),
            log_det=known[seed].log_det,
            log_det_of_starts=list(known[seed].starts),
        )

    return make


def _seed(seed: int, role: Role, which: int) -> int:
    return 100_000 * seed + 10 * which + ROLES.index(role)
