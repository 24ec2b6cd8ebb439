"""A replacement for the sandbox that runs calls in this process and saves the process start."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class InProcess:
    """Answers calls as :class:`pytest_twin.realization.sandbox.Sandbox` does."""

    output = ""

    def __init__(self, *, cwd: Path | None = None, **bounds: Any) -> None:
        self._cwd = cwd

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def close(self) -> None:
        """End nothing: there is no child."""

    def call(
        self,
        function: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        progress: Callable[[float], None] | None = None,
        tell: Callable[[str, str], None] | None = None,
        seconds: float | None = None,
    ) -> Any:
        """Call ``module:function`` with keyword arguments; both ways through JSON.

        ``seconds`` limits nothing here.
        """
        module, _, name = function.partition(":")
        target = getattr(importlib.import_module(module), name)
        given = {"progress": progress or _ignored, "tell": tell or _ignored}
        taken = {n: f for n, f in given.items() if n in inspect.signature(target).parameters}
        with contextlib.chdir(self._cwd or Path.cwd()):
            result = target(**json.loads(json.dumps(dict(arguments or {}))), **taken)
        return json.loads(json.dumps(result))


def _ignored(*report: object) -> None:
    """A report that nobody reads."""
