"""Read the up axis of a COLLADA file."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.formats import xml

DEFAULT_UP_AXIS = "Y_UP"
"""Up axis of a file that states none, by the COLLADA specification."""


def stated_up_axis(path: Path) -> str | None:
    """Return ``X_UP``, ``Y_UP`` or ``Z_UP`` as stated; None if the file states none.

    Raises:
        FormatError: not well-formed, or a limit is exceeded.
    """
    for element in xml.parse(path).iter("{*}asset"):
        text = (element.findtext("{*}up_axis") or "").strip()
        return text or None
    return None
