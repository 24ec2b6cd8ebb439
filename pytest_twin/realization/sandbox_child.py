"""Main program of the child process of :mod:`pytest_twin.realization.sandbox`."""

from __future__ import annotations

import importlib
import inspect
import json
import math
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

from pytest_twin import interrupts, processor_time
from pytest_twin.errors import (
    DISK_ERRORS,
    LimitError,
    SimulationError,
    TwinError,
    cannot_write,
)
from pytest_twin.formats.declared_inputs import DeclaredInputs, declaring


def main(
    request_descriptor: int, answer_descriptor: int, memory_bytes: int, stop_descriptor: int = -1
) -> None:
    """Answer calls until the parent closes the pipe."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    interrupts.leave_interrupts_to_parent()
    if stop_descriptor >= 0:
        interrupts.receive_stop(stop_descriptor)
    _bound_memory(memory_bytes)
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    os.set_inheritable(request_descriptor, False)
    os.set_inheritable(answer_descriptor, False)
    with (
        os.fdopen(request_descriptor, "rb") as requests,
        os.fdopen(answer_descriptor, "wb") as answers,
    ):
        while head := requests.read(8):
            request = json.loads(requests.read(int.from_bytes(head, "big")))
            _send(answers, _answer(request, answers))


def _end_with_parent(parent: int) -> None:
    """End the child if its parent was killed, because the parent can no longer end it."""
    while os.getppid() == parent:
        time.sleep(1.0)
    # The process group contains the child and its forks, and nothing else.
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _send(answers: BinaryIO, answer: Mapping[str, Any]) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    content = json.dumps(answer).encode()
    answers.write(len(content).to_bytes(8, "big") + content)
    answers.flush()


def _answer(request: Mapping[str, Any], answers: BinaryIO) -> dict[str, Any]:
    _bound_cpu(request["seconds"])
    processor_time.begin_call()
    try:
        with declaring(DeclaredInputs.of(request["declared"])):
            result = _call(request["function"], request["arguments"], answers)
        json.dumps(result)
        return {"result": result}
    except TwinError as error:
        return {"error": _error_to_json(error)}
    except MemoryError:
        return {"error": _error_to_json(_out_of_memory())}
    except (Exception, SystemExit) as error:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            return {"error": _error_to_json(cannot_write(error))}
        if "could not allocate memory" in str(error).lower():
            # MuJoCo reports a lack of memory with this text.
            return {"error": _error_to_json(_out_of_memory())}
        traceback.print_exc()
        # The innermost frame is the place of the error, for example in a user's function.
        frames = traceback.extract_tb(error.__traceback__)
        place = frames[-1] if frames else None
        words = str(error) or "no message"
        return {
            "error": _error_to_json(
                SimulationError(
                    f"{type(error).__name__}: {words}",
                    path=None if place is None else place.filename,
                    line=None if place is None else place.lineno,
                )
            )
        }


def _out_of_memory() -> LimitError:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return LimitError("ran out of memory", expected="more free memory, or a smaller model")
    return LimitError("ran out of memory", expected=f"at most {limit / 2**20:.0f} MiB")


def _bound_memory(memory_bytes: int) -> None:
    """Limit the address space; a lower limit of the system stays."""
    bound = _within_hard_limit(memory_bytes, resource.RLIMIT_AS)
    try:
        resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    except (ValueError, OSError):
        # macOS has no such limit; there only the time limits apply.
        if sys.platform == "linux":
            raise


def _within_hard_limit(wanted: int, limit: int) -> int:
    """``wanted``, or the hard limit of this process where that is lower."""
    hard = resource.getrlimit(limit)[1]
    return wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)


def _bound_cpu(seconds: float) -> None:
    """Set a limit of CPU time in the child, which applies even after the parent has ended."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    used = usage.ru_utime + usage.ru_stime
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    if math.isinf(seconds):
        resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
        return
    soft = int(used + seconds * (os.cpu_count() or 1) + 5)
    resource.setrlimit(resource.RLIMIT_CPU, (_within_hard_limit(soft, resource.RLIMIT_CPU), hard))


def _call(function: str, arguments: Mapping[str, Any], answers: BinaryIO) -> Any:
    module, _, name = function.partition(":")
    target: Callable[..., Any] = getattr(importlib.import_module(module), name)

    def progress(fraction: float) -> None:
        _send(answers, {"progress": float(fraction)})

    def tell(kind: str, text: str) -> None:
        _send(answers, {"tell": [kind, text]})

    parameters = inspect.signature(target).parameters
    given = {"progress": progress, "tell": tell}
    return target(**arguments, **{name: f for name, f in given.items() if name in parameters})


def _error_to_json(error: TwinError) -> dict[str, Any]:
    return {
        "kind": type(error).__name__,
        "problem": error.problem,
        "path": None if error.path is None else str(error.path),
        "line": error.line,
        "column": error.column,
        "where": error.where,
        "value": error.value
        if isinstance(error.value, int | float | str | None)
        else str(error.value),
        "unit": error.unit,
        "expected": error.expected,
    }


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:5]))
