"""``pytest-twin effects``: list the effects that a diagnosis can identify."""

from __future__ import annotations

import argparse
import sys

from pytest_twin.commands import json_output
from pytest_twin.effects import catalogue
from pytest_twin.effects.card import as_json, cards

HELP = "list the physical effects that a diagnosis can name, with laws, parameters and sources"
EXAMPLES = ("pytest-twin effects | less", "pytest-twin effects --json - | jq 'keys'")
EXIT_STATUS = {0: "the catalogue is printed"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Do nothing: the command has no arguments."""


def run(args: argparse.Namespace) -> int:
    """Print the catalogue as Markdown; return 0."""
    effects = catalogue()
    json_output.give(args, as_json(effects))
    sys.stdout.write(cards(effects))
    return 0
