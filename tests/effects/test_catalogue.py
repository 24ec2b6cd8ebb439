"""What the catalogue says of itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.effects import catalogue
from pytest_twin.effects.card import cards

DOCS = Path(__file__).parents[2] / "docs" / "effects.md"


def test_the_docs_hold_what_the_command_prints() -> None:
    """Rewrite the part below the mark with ``pytest-twin effects``."""
    _, listed = DOCS.read_text().split("<!-- pytest-twin effects -->\n")
    assert listed == cards(catalogue())


@pytest.mark.parametrize("effect", catalogue().values(), ids=lambda effect: effect.id)
def test_it_is_confused_with_others_of_the_catalogue(effect) -> None:
    assert effect.confused_with
    assert effect.id not in effect.confused_with
    assert {*effect.confused_with, *effect.generalizes} <= catalogue().keys()
