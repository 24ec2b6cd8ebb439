"""What a COLLADA file says about its axes."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.formats import xml

DEFAULT_UP_AXIS = "Y_UP"
"""Of a file without ``up_axis``, by the COLLADA specification."""


def stated_up_axis(path: Path) -> str | None:
    """``X_UP``, ``Y_UP`` or ``Z_UP`` as the file states it; None where it states none.

    Raises:
        FormatError: not well-formed, or beyond a bound.
    """
    for element in xml.parse(path).iter("{*}asset"):
        text = (element.findtext("{*}up_axis") or "").strip()
        return text or None
    return None
