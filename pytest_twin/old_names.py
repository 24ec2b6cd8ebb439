"""Old names of public attributes, which warn for one release."""

from __future__ import annotations

import warnings
from typing import Any


def old_name(old: str, new: str) -> Any:
    """A property that warns and returns the attribute ``new``; the setter does the same.

    Args:
        old: former name of the attribute.
        new: its name now.
    """

    def warn(owner: object) -> None:
        name = type(owner).__name__
        warnings.warn(f"{name}.{old} is now {name}.{new}", DeprecationWarning, stacklevel=3)

    def get(self: object) -> Any:
        warn(self)
        return getattr(self, new)

    def set_(self: object, value: Any) -> None:
        warn(self)
        setattr(self, new, value)

    return property(get, set_, doc=f"Old name of :attr:`{new}`; it goes with version 0.2.")
