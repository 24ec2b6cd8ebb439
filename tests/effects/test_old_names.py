"""Old names of the effect interface work for one more release and warn."""

import contextlib

import numpy as np
import pytest

from pytest_twin.audit.asset import Joint, Mimic
from pytest_twin.effects import ModelFields, World
from pytest_twin.effects.motor_side import Gear
from pytest_twin.properties import Property


def world() -> World:
    """One row, one joint, a position servo with a constant effort."""
    one = {
        name: np.full((1, 1), value)
        for name, value in {
            "position": 0.1, "velocity": 0.2, "setpoint": 0.5, "gain": 6.0, "stiffness": 6.0,
            "damping": 0.3, "offset": 1.0, "lower": -5.0, "upper": 5.0, "delivered": 0.0,
            "friction_level": 0.0, "applied": 0.0, "load": 0.0, "motor_armature": 0.0,
            "motor_damping": 0.0, "motor_constant_effort": 0.0, "link_inertia": 1.0,
        }.items()
    }  # fmt: skip
    return World(
        time=np.zeros(1), timestep=0.002, servo=np.array(["position"]),
        cold_fraction=np.array([0.25]), **one,
    )  # fmt: skip


def test_the_old_name_of_the_control_effort_warns_and_returns_the_same() -> None:
    here = world()
    with pytest.warns(DeprecationWarning, match=r"World\.asked is now World\.control_effort"):
        effort = here.asked(here.position, here.velocity)
    assert effort == pytest.approx(6.0 * 0.5 - 6.0 * 0.1 - 0.3 * 0.2 + 1.0)
    assert effort == here.control_effort(here.position, here.velocity)


def test_the_old_name_of_the_cold_fraction_warns_and_returns_the_same() -> None:
    here = world()
    with pytest.warns(DeprecationWarning, match=r"World\.coldness is now World\.cold_fraction"):
        assert here.coldness == pytest.approx([0.25])


@pytest.mark.parametrize(
    ("owner", "old", "new"),
    [
        (Joint, "limited", "is_limited"),
        (Joint, "continuous", "is_continuous"),
        (Joint, "limit_stated", "has_stated_limit"),
        (Joint, "soft_stated", "has_stated_soft_limit"),
        (Mimic, "active", "is_active"),
        (ModelFields, "changes_links", "has_changed_links"),
        (World, "motor_constant", "motor_constant_effort"),
        (Gear, "apart", "is_elastic"),
        (Gear, "give", "add_compliance"),
        (Gear, "stretch", "deflection"),
        (Property, "posed", "needs_poses"),
    ],
)
def test_old_names_of_the_public_interface_warn_and_state_the_new_name(
    owner: type, old: str, new: str
) -> None:
    bare = owner.__new__(owner)
    with (
        pytest.warns(DeprecationWarning, match=rf"{owner.__name__}\.{old} is now .*\.{new}"),
        contextlib.suppress(AttributeError),
    ):
        getattr(bare, old)
    assert hasattr(owner, new)
