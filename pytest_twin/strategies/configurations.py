"""Strategy for configurations of a robot within its limits and with all couplings satisfied."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from pytest_twin.checks.poses import Configurations
from pytest_twin.errors import SpecError

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


_STEPS = 2**20
"""Number of values between the limits of a joint."""


def configurations(
    robot: Realization | Path | str | Any, joints: Mapping[str, float] | None = None
) -> st.SearchStrategy[dict[str, float]]:
    """Draw values of all hinges (rad) and slides (m) of a robot.

    Independent joints are drawn within their limits, and so that their followers (mimic, polynomial
    couplings) stay within theirs. A joint without limits is drawn within pi rad, or 1 m, of its
    reference. Followers and closed loops are computed; ball and free joints are at their reference.

    Args:
        robot: a realization, a ``mujoco.MjModel``, or the path of an MJCF, a URDF or a
            ``twin.yaml`` (its first realization).
        joints: independent joint -> fixed value, rad or m.

    Raises:
        TwinError: a file that is not a robot.
        SpecError: a name in ``joints`` that is not an independent joint.
    """
    free = Configurations(_model(robot))
    held = dict(joints or {})
    for joint in held:
        if joint not in free.independent:
            raise SpecError(
                "not an independent joint",
                where="joints",
                value=joint,
                expected=", ".join(sorted(free.independent)) or "none: nothing moves",
            )
    drawn = st.fixed_dictionaries(
        {
            joint: st.just(held[joint]) if joint in held else _between(lower, upper)
            for joint, (lower, upper) in free.independent.items()
        }
    )
    # A configuration in which a loop cannot close is drawn again.
    return drawn.map(free.complete).filter(lambda q: q is not None)  # type: ignore[return-value]


def _between(lower: float, upper: float) -> st.SearchStrategy[float]:
    """Uniform values including both ends; examples shrink towards 0, or the end closest to 0.

    Hypothesis draws plain floats mostly near 0, where many faults have no effect.
    """
    rest = min(max(0.0, lower), upper)
    step = (upper - lower) / _STEPS
    if not step > 0:
        return st.just(rest)
    below, above = math.ceil((rest - lower) / step), math.ceil((upper - rest) / step)
    return st.integers(-below, above).map(
        lambda number: min(max(rest + number * step, lower), upper)
    )


def _model(robot: Any) -> Any:
    if isinstance(robot, str | Path):
        return load_any(Path(robot)).model
    return getattr(robot, "model", robot)


def load_any(path: Path) -> Realization:
    """Load an MJCF, a URDF, or the first realization of a ``twin.yaml``."""
    from pytest_twin.realization import load
    from pytest_twin.twin import load_twin

    if path.suffix not in (".yaml", ".yml"):
        return load(path)
    twin = load_twin(path)
    first = twin.first_realization
    return load(first.file, twin=twin, name=first.name)
