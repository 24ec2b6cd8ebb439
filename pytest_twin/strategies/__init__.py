"""Hypothesis strategies for property tests: configurations, perturbed assets, random robots.

They need hypothesis: ``pip install 'pytest-twin[properties]'``.
"""

from __future__ import annotations

try:
    import hypothesis as _hypothesis
except ModuleNotFoundError as _error:
    if _error.name != "hypothesis":
        raise
    raise ImportError(
        "pytest_twin.strategies needs hypothesis: pip install 'pytest-twin[properties]'"
    ) from None

from pytest_twin.strategies.configurations import configurations
from pytest_twin.strategies.drawn_robot import DrawnRobot
from pytest_twin.strategies.perturbation import Perturbation, Spread, perturbed_assets
from pytest_twin.strategies.robot_elements import DrawnJoint, DrawnLink, DrawnShape
from pytest_twin.strategies.robots import mjcf_robots, robots, urdf_robots

del _hypothesis

__all__ = [
    "DrawnJoint",
    "DrawnLink",
    "DrawnRobot",
    "DrawnShape",
    "Perturbation",
    "Spread",
    "configurations",
    "mjcf_robots",
    "perturbed_assets",
    "robots",
    "urdf_robots",
]
