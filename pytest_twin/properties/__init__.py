"""Property tests for the realizations of any robot.

One line in a test file makes a test of each property::

    from pytest_twin.properties import asset_properties

    test_asset = asset_properties("twin.yaml")

They need hypothesis: ``pip install 'pytest-twin[properties]'``.
"""

from __future__ import annotations

from pytest_twin.properties.asset import Asset
from pytest_twin.properties.form import Form
from pytest_twin.properties.suite import PROPERTIES, Property, asset_properties
from pytest_twin.properties.tolerances import Tolerances
from pytest_twin.properties.violation import Broken, PropertyError

__all__ = [
    "PROPERTIES",
    "Asset",
    "Broken",
    "Form",
    "Property",
    "PropertyError",
    "Tolerances",
    "asset_properties",
]
