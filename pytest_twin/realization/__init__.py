"""Robots as simulators see them: the only room, with replay, that loads a model.

Nothing heavy is imported until a name is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_twin.realization.loading import load
    from pytest_twin.realization.model import Realization
    from pytest_twin.realization.reference import Reference
    from pytest_twin.realization.sandbox import Sandbox

__all__ = ["Realization", "Reference", "Sandbox", "load"]

_HOMES = {"Realization": "model", "Reference": "reference", "Sandbox": "sandbox", "load": "loading"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
