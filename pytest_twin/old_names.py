"""Former names of public attributes, kept for one release with a deprecation warning."""

from __future__ import annotations

import warnings
from typing import Any


def old_name(old: str, new: str) -> Any:
    """Property that reads and writes the attribute ``new`` and warns of the former name.

    Args:
        old: former name of the attribute.
        new: present name of the attribute.
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
