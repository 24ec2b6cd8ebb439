"""``pytest-twin effects``: what a diagnosis can name."""

from __future__ import annotations

import argparse
import sys

from pytest_twin.effects import catalogue
from pytest_twin.effects.card import cards

HELP = "list what a diagnosis can name: laws, parameters, bounds, and what each is confused with"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """It takes none."""


def run(args: argparse.Namespace) -> int:
    """Print the catalogue as Markdown; always 0."""
    sys.stdout.write(cards(catalogue()))
    return 0
