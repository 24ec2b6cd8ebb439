"""Friction laws against their closed forms: a slide without gravity that coasts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from pytest_twin.effects import catalogue
from pytest_twin.effects.rows import RowSimulator, Segment

MASS, VISCOUS, STEP = 2.0, 3.0, 0.0005
LAW = catalogue()["asymmetric_viscous_friction"]


def coast(speed: float, values: dict[str, float], seconds: float = 1.0) -> NDArray[np.float64]:
    """Positions (steps,) of a slide that is let go at ``speed``, m/s."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast" gravity="0 0 0"/><worldbody>'
        f'<body><inertial pos="0 0 0" mass="{MASS}" diaginertia="1 1 1"/>'
        f'<joint name="j" type="slide" axis="1 0 0" damping="{VISCOUS}"/></body></worldbody>'
        '<actuator><motor joint="j"/></actuator></mujoco>'
    )
    time = STEP * np.arange(round(seconds / STEP), dtype=np.float64)
    segment = Segment(
        trial=0, model=model, mode="effort", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=time, command=np.zeros((len(time), 1)),
        initial_position=np.zeros(1), initial_velocity=np.array([speed]),
    )  # fmt: skip
    each = {LAW.id: {n: np.full((1, 1), v) for n, v in values.items()}} if values else {}
    return (
        RowSimulator([segment], ("j",), threads=1).simulate(np.array([0]), each)[0].position[:, 0]
    )


@pytest.mark.parametrize("speed", [0.8, -0.8])
@pytest.mark.parametrize("coefficient", [1.2, -1.2])
def test_viscous_friction_differs_by_direction(speed: float, coefficient: float) -> None:
    time = STEP * np.arange(2000)
    found = coast(speed, {"coefficient": coefficient})
    # v' = -(b + c) v forwards, -(b - c) v backwards: an exponential of its own for either way.
    rate = (VISCOUS + np.sign(speed) * coefficient) / MASS
    expected = speed / rate * -np.expm1(-rate * time)
    assert np.abs(found - expected).max() < 2e-4
    mean = VISCOUS / MASS
    assert np.abs(found - speed / mean * -np.expm1(-mean * time)).max() > 0.05


def test_its_unit_is_that_of_viscous_friction() -> None:
    viscous = catalogue()["viscous_friction"].parameters[0]
    mine = LAW.parameters[0]
    for kind in ("hinge", "slide"):
        assert mine.unit(kind) == viscous.unit(kind)
    assert mine.lower < 0.0 < mine.upper
    assert mine.reference == viscous.reference


def test_neutral_it_changes_nothing() -> None:
    assert np.array_equal(coast(0.8, {"coefficient": 0.0}, 0.2), coast(0.8, {}, 0.2))


def test_what_it_is_confused_with_is_in_the_catalogue_and_says_so_too() -> None:
    assert set(LAW.confused_with) <= set(catalogue())
    for other in ("asymmetric_friction", "viscous_friction"):
        assert LAW.id in catalogue()[other].confused_with
