"""Quantities with units, and the text of errors."""

from __future__ import annotations

import math
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_twin.errors import FormatError, SpecError, TwinError
from pytest_twin.units import Quantity, parse_quantity


@pytest.mark.parametrize(
    ("text", "si"),
    [
        ("0.5 mm", Quantity(0.5e-3, "m")),
        ("180 deg", Quantity(math.pi, "rad")),
        ("1e-6 rad", Quantity(1e-6, "rad")),
        (".5 %", Quantity(0.005, "1")),
        ("2 Nm", Quantity(2.0, "N*m")),
        ("0.21", Quantity(0.21, "1")),
        (11, Quantity(11.0, "1")),
    ],
)
def test_quantities_are_converted_to_si(text: str, si: Quantity) -> None:
    assert parse_quantity(text, (si.unit,)) == si


def test_a_unit_of_another_dimension_is_refused_with_the_expected_units() -> None:
    with pytest.raises(SpecError) as error:
        parse_quantity("5 s", ("m",))
    assert str(error.value) == (
        "unit 's' does not fit (got '5 s'; expected a number and a unit, such as "
        "'1 m' or '1 mm' or '1 um')"
    )


@pytest.mark.parametrize(
    "text", ["11", 11, "0.21", True, "mm", "nan m", "1e999 m", None, "1 m\n2 m", "--1 m"]
)
def test_a_text_that_is_not_a_quantity_is_refused(text: object) -> None:
    with pytest.raises(SpecError):
        parse_quantity(text, ("m",))


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_any_finite_number_with_unit_is_read_back(value: float) -> None:
    assert parse_quantity(f"{value!r} m", ("m",)).value == value


def test_an_error_states_place_value_and_expected_value() -> None:
    error = FormatError(
        "negative",
        path="a/b.xml",
        line=3,
        column=7,
        where="mass",
        value=-1.0,
        unit="kg",
        expected="> 0",
    )
    assert str(error) == "a/b.xml:3:7: mass: negative (got -1.0 kg; expected > 0)"


@given(st.text())
def test_an_error_is_always_one_printable_line(text: str) -> None:
    shown = str(TwinError("bad", value=text, where=text))
    assert shown.isprintable()
    assert len(shown.splitlines()) == 1


def test_an_error_survives_the_transfer_between_processes() -> None:
    error = SpecError("bad", path="x.yaml", line=2, value=3)
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is SpecError
    assert str(again) == str(error)


def test_a_number_without_unit_is_not_accepted_as_a_length() -> None:
    with pytest.raises(SpecError, match="the unit is missing"):
        parse_quantity("0.21", ("m",))
