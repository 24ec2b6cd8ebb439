"""Calls and commands without the start of a process, which takes half a second or more."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest


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


class GateInProcess(InProcess):
    """Forgets the models that it loaded when its run ends, as a child does."""

    def __init__(self, **bounds: Any) -> None:
        from pytest_twin.gate import worker

        super().__init__(**bounds)
        for kept in vars(worker).values():
            if hasattr(kept, "cache_clear"):
                kept.cache_clear()


def forked_pytest(
    *arguments: str, cwd: Path, env: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run pytest in a fork, which has imported everything; its gate runs goldens in the fork."""
    from pytest_twin.gate import failure_diagnosis, runner

    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if child == 0:
            status = 70
            try:
                signal.alarm(600)
                for number, file in ((1, out), (2, err)):
                    os.dup2(file.fileno(), number)
                sys.stdout, sys.stderr = (
                    os.fdopen(number, "w", encoding="utf-8", closefd=False) for number in (1, 2)
                )
                os.environ.clear()
                os.environ.update(env)
                os.chdir(cwd)
                runner.Sandbox = failure_diagnosis.Sandbox = GateInProcess  # type: ignore[misc,assignment]
                status = int(pytest.main(["-p", "no:xdist", *arguments]))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.seek(0)
        err.seek(0)
        texts = (file.read().decode() for file in (out, err))
        return subprocess.CompletedProcess(("pytest", *arguments), status, *texts)
