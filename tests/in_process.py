"""A replacement for the sandbox that runs calls in this process and saves the process start."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any


class InProcess:
    """Answers calls as :class:`pytest_twin.realization.sandbox.Sandbox` does."""

    def __init__(self, **bounds: Any) -> None:
        pass

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def call(self, function: str, arguments: Mapping[str, Any], progress: object = None) -> Any:
        """Call ``module:function`` with keyword arguments; progress is not reported."""
        module, _, name = function.partition(":")
        return getattr(importlib.import_module(module), name)(**arguments)
