"""The option ``--seconds`` of every command that estimates."""

from __future__ import annotations

import argparse
import math

from pytest_twin.commands.numbers import number

MOST_SECONDS = 7 * 24 * 3600.0
"""Largest limit, s."""
_WALL_SECONDS, _WALL_PER_SECOND = 4 * 3600.0, 20.0
"""Wall time after which a child process is ended as hung: the first, s, and the second for each
second of the limit. A busy machine gives a command a small part of its processors."""


def add_seconds(parser: argparse.ArgumentParser, default: float, at_the_limit: str) -> None:
    """Declare ``--seconds``.

    Args:
        default: default limit, s; 0 for none.
        at_the_limit: what is written then.
    """
    shown = f"{default:g}; 0: no limit" if default else "0, no limit"
    parser.add_argument(
        "--seconds",
        metavar="N",
        type=number(
            lambda limit: 0.0 <= limit <= MOST_SECONDS,
            f"processor seconds, 0 to {MOST_SECONDS:g} (0: no limit)",
        ),
        default=default,
        help="limit of the processor time in processor seconds, all cores together, at which "
        f"{at_the_limit} (default: {shown}); Ctrl-C and SIGTERM do the same at once",
    )


def wall_limit(limit: float) -> float:
    """Wall time after which the child process of a command is ended as hung, s.

    Args:
        limit: limit of the processor time, s; 0 for none.
    """
    return _WALL_SECONDS + _WALL_PER_SECOND * limit if limit else math.inf
