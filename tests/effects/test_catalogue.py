"""The documentation and the confusion lists of the effect catalogue."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.effects import catalogue
from pytest_twin.effects.card import cards

DOCS = Path(__file__).parents[2] / "docs" / "effects.md"


def test_the_docs_contain_the_output_of_the_effects_command() -> None:
    """If this fails, replace the text below the mark with the output of ``pytest-twin effects``."""
    _, listed = DOCS.read_text().split("<!-- pytest-twin effects -->\n")
    assert listed == cards(catalogue())


@pytest.mark.parametrize("effect", catalogue().values(), ids=lambda effect: effect.id)
def test_an_effect_lists_only_other_catalogue_effects_as_confusable(effect) -> None:
    assert effect.confused_with
    assert effect.id not in effect.confused_with
    assert {*effect.confused_with, *effect.generalizes} <= catalogue().keys()
