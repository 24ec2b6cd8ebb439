"""Numbers of a command line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def number(is_valid: Callable[[float], bool], expected: str) -> Callable[[str], float]:
    """Return a parser of valid numbers, for ``type=`` of an argument.

    Args:
        is_valid: whether a number is one; False for NaN, as comparisons with NaN are.
        expected: description of a valid number, for the error.
    """

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not is_valid(value):
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")
        return value

    return parse
