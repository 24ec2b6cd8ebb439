"""Regressor of the inverse dynamics, base parameters, and their predicted covariance.

The public surface, in the order of use::

    regressor = Regressor(realization, joints)            # names: the order of all columns
    matrix = regressor.matrix(position, velocity, acceleration)   # (n, joints, p), SI units
    base = structural_base(regressor)                     # b combinations out of p parameters
    prediction = predicted_covariance(base.matrix(matrix), effort_std)  # (b, b), undetermined

``base.expressions`` are sums in the literature's symbols, ``base.words`` the same with joint names.
"""

from pytest_twin.estimation.covariance import Prediction, predicted_covariance
from pytest_twin.identification.regressor.base_parameters import (
    BaseParameters,
    base_of,
    structural_base,
)
from pytest_twin.identification.regressor.columns import Column, SharedMotor
from pytest_twin.identification.regressor.regressor import Regressor

__all__ = [
    "BaseParameters",
    "Column",
    "Prediction",
    "Regressor",
    "SharedMotor",
    "base_of",
    "predicted_covariance",
    "structural_base",
]
