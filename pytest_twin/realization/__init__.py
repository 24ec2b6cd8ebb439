"""Load robot models for simulators: MJCF, URDF, USD and installed formats.

The simulators are imported only when a name of this package is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_twin.realization.loading import load
    from pytest_twin.realization.model import Realization
    from pytest_twin.realization.reference import Reference
    from pytest_twin.realization.sandbox import Sandbox

__all__ = ["Realization", "Reference", "Sandbox", "load"]

_MODULES = {
    "Realization": "model",
    "Reference": "reference",
    "Sandbox": "sandbox",
    "load": "loading",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
