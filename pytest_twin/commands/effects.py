"""``pytest-twin effects``: list the effects that a diagnosis can identify, or describe some."""

from __future__ import annotations

import argparse
import sys

from pytest_twin.commands import json_output
from pytest_twin.commands.help import did_you_mean
from pytest_twin.commands.terminal import show
from pytest_twin.effects import catalogue
from pytest_twin.effects.card import as_json, cards, description
from pytest_twin.errors import TwinError

EXAMPLES = ("pytest-twin effects backlash", "pytest-twin effects --json - | jq 'keys'")
EXIT_STATUS = {0: "the effects are printed"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help="effects to describe: law, parameters with units, source, similar effects and the "
        "tests that separate them (default: all effects, as Markdown)",
    )


def run(args: argparse.Namespace) -> int:
    """Print the named effects, or the catalogue as Markdown; return 0.

    Raises:
        TwinError: there is no effect of a name.
    """
    effects = catalogue()
    for name in args.names:
        if name not in effects:
            raise TwinError(
                f"there is no effect {name!r}{did_you_mean(name, effects)}",
                expected="a name from the list of pytest-twin effects",
            )
    if not args.names:
        json_output.give(args, as_json(effects))
        sys.stdout.write(cards(effects))
        return 0
    chosen = {name: effects[name] for name in args.names}
    json_output.give(args, as_json(chosen))
    show("\n\n".join(description(effect) for effect in chosen.values()))
    return 0
