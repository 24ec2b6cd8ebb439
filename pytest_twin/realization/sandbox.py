"""A child process that loads and steps untrusted models, with limits of time and memory.

The child is a new interpreter. It receives calls through one pipe and answers through another, both
as JSON, so that its answers cannot execute code in the parent. This module imports no simulator.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Self

from pytest_twin import errors
from pytest_twin.errors import LimitError, SimulationError, TwinError
from pytest_twin.formats.declared_inputs import declared_inputs
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.interrupts import StopRequest, deferred_interrupts
from pytest_twin.realization.confinement import confined_command, confined_environment
from pytest_twin.realization.import_path import import_path

MEMORY_BYTES = 8 * 2**30
"""Default of the child's memory limit."""
SECONDS = 300.0
"""Default of the child's time limit."""
_ANSWER_BYTES = 512 * 2**20
"""Largest size of an answer of the child."""
_OUTPUT_BYTES = 64 * 2**10
"""Number of bytes of the child's text output that are kept, for messages."""
# Time within which a child must end after it closed its pipes, s.
_END_SECONDS = 5.0


class Sandbox:
    """A child process that answers calls one after another until it is closed.

    A child that was killed or crashed is replaced at the next call. Calls from several threads
    wait for one another.

    Args:
        memory_bytes: limit of the child's address space, bytes.
        seconds: limit of the wall time of one call, s, also of its CPU time per core; infinite
            for none.
        cwd: working directory of the child.
        confined_to: folders that the child may read in addition to those of Python; it may then
            write only its temporary folder and those in ``write``. None for a child with the
            user's rights.
        write: further folders that a confined child may write.
        untrusted: folders from which the child imports no module, in addition to those that
            :func:`~pytest_twin.realization.import_path.import_path` leaves out.
        stop: request that ends a function of the child early, if the function asks for it.
    """

    def __init__(
        self,
        *,
        memory_bytes: int = MEMORY_BYTES,
        seconds: float = SECONDS,
        cwd: Path | None = None,
        confined_to: Collection[Path] | None = None,
        write: Collection[Path] = (),
        untrusted: Collection[Path] = (),
        stop: StopRequest | None = None,
    ) -> None:
        self.memory_bytes = memory_bytes
        self.confined_to = confined_to
        self.write = write
        self.untrusted = untrusted
        self.seconds = seconds
        self.cwd = cwd
        self.stop = stop
        self._lock = threading.Lock()
        self._child: _Child | None = None
        self._output = b""

    @property
    def output(self) -> str:
        """The last 64 KiB that the last call wrote to standard output and standard error."""
        return self._output.decode("utf-8", "replace")

    def call(
        self,
        function: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        seconds: float | None = None,
        progress: Callable[[float], None] | None = None,
        tell: Callable[[str, str], None] | None = None,
    ) -> Any:
        """Call ``module:function`` with keyword ``arguments`` in the child.

        A function with a parameter ``progress`` gets a callback for the fraction that is done. A
        function with a parameter ``tell`` gets a callback for a message: its kind and its text.

        Args:
            function: ``module:function``.
            seconds: time limit of this call, s; that of the sandbox by default.
            progress: called in this thread with each fraction that the function reports.
            tell: called in this thread with each message.

        Returns:
            The result of the function, which must be JSON-able; tuples become lists.

        Raises:
            TwinError: an error that the function raised.
            LimitError: the time or memory limit was exceeded; the child is killed.
            SimulationError: the child crashed, or the function raised another exception.
        """
        bound = self.seconds if seconds is None else seconds
        with self._lock:
            self._output = b""
            if self._child is None:
                self._child = _Child(self)
            request = {
                "function": function,
                "arguments": dict(arguments or {}),
                "seconds": bound,
                "declared": declared_inputs().to_json(),
            }
            try:
                answer = self._exchange(self._child, request, bound, progress, tell)
            except BaseException:
                # After any exception, the state of the child is unknown.
                self._discard()
                raise
        if "error" in answer:
            raise _error_from_json(answer["error"])
        return answer["result"]

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _discard(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _exchange(
        self,
        child: _Child,
        request: Mapping[str, Any],
        bound: float,
        progress: Callable[[float], None] | None,
        tell: Callable[[str, str], None] | None,
    ) -> dict[str, Any]:
        deadline = time.monotonic() + bound
        try:
            child.send(json.dumps(request).encode())
        except OSError:
            raise child.crash_error(self._output, self.memory_bytes, bound) from None
        buffer = bytearray()
        with selectors.DefaultSelector() as selector:
            selector.register(child.answers, selectors.EVENT_READ)
            selector.register(child.output, selectors.EVENT_READ)
            while True:
                remaining = deadline - time.monotonic()
                limit = None if math.isinf(remaining) else remaining
                events = selector.select(limit) if remaining > 0 else []
                if not events:
                    raise LimitError(
                        "exceeded its time limit and was killed",
                        expected=f"at most {bound:g} s",
                    )
                for key, _ in events:
                    data = os.read(key.fd, 1 << 16)
                    if key.fd == child.output:
                        self._output = (self._output + data)[-_OUTPUT_BYTES:]
                        if not data:
                            selector.unregister(child.output)
                        continue
                    if not data:
                        self._drain(child)
                        raise child.crash_error(self._output, self.memory_bytes, bound)
                    buffer += data
                for answer in _complete_answers(buffer):
                    if "progress" in answer:
                        if progress is not None:
                            progress(float(answer["progress"]))
                    elif "tell" in answer:
                        if tell is not None:
                            kind, text = answer["tell"]
                            tell(str(kind), str(text))
                    else:
                        self._drain(child)
                        return answer

    def _drain(self, child: _Child) -> None:
        """Read the output that the child has written so far, without waiting."""
        os.set_blocking(child.output, False)
        with contextlib.suppress(BlockingIOError):
            while data := os.read(child.output, 1 << 16):
                self._output = (self._output + data)[-_OUTPUT_BYTES:]
        os.set_blocking(child.output, True)


def _complete_answers(buffer: bytearray) -> list[dict[str, Any]]:
    """Remove the complete answers from the front of ``buffer``, and return them."""
    found = []
    while len(buffer) >= 8:
        size = int.from_bytes(buffer[:8], "big")
        if size > _ANSWER_BYTES:
            raise SimulationError(
                "the child process sent too large an answer",
                value=size,
                unit="bytes",
                expected=f"at most {_ANSWER_BYTES} bytes",
            )
        if len(buffer) < 8 + size:
            break
        try:
            answer = json.loads(buffer[8 : 8 + size])
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise SimulationError(
                "the child process sent an answer that cannot be read",
                expected="one JSON object; run it again",
            )
        found.append(answer)
        del buffer[: 8 + size]
    return found


class _Child:
    """One interpreter and the pipes to it."""

    def __init__(self, sandbox: Sandbox) -> None:
        request_read, self.requests = os.pipe()
        self.answers, answer_write = os.pipe()
        self.output, output_write = os.pipe()
        environment = dict(os.environ)
        cwd = sandbox.cwd
        imports = import_path((*sandbox.untrusted, *([] if cwd is None else [cwd])))
        # An entry with a separator in its name would be taken for two. Python itself adds the
        # folders of installed distributions again.
        environment["PYTHONPATH"] = os.pathsep.join(e for e in imports if os.pathsep not in e)
        # The forks use all cores, and sums in several threads depend on the number of threads.
        environment.setdefault("OPENBLAS_NUM_THREADS", "1")
        command = [
            sys.executable,
            # No module of the working folder; -I would ignore PYTHONPATH, and so ROS overlays.
            "-P",
            "-m",
            "pytest_twin.realization.sandbox_child",
            str(request_read),
            str(answer_write),
            str(sandbox.memory_bytes),
        ]
        inherited = [request_read, answer_write]
        if sandbox.stop is not None:
            inherited.append(sandbox.stop.descriptor)
            command.append(str(sandbox.stop.descriptor))
        scratch = contextlib.ExitStack()
        if sandbox.confined_to is not None:
            place = scratch.enter_context(temporary_folder())
            command = confined_command(command, imports, sandbox.confined_to, place, sandbox.write)
            environment = confined_environment(environment, place)
        try:
            with deferred_interrupts():
                self.process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=output_write,
                    stderr=output_write,
                    pass_fds=inherited,
                    cwd=cwd,
                    env=environment,
                    # A separate process group, so that a kill ends its children too.
                    start_new_session=True,
                )
        finally:
            for descriptor in (request_read, answer_write, output_write):
                os.close(descriptor)
        self.kill = weakref.finalize(
            self, _end, self.process, (self.requests, self.answers, self.output), scratch
        )

    def send(self, content: bytes) -> None:
        view = memoryview(len(content).to_bytes(8, "big") + content)
        while view:
            view = view[os.write(self.requests, view) :]

    def crash_error(self, output: bytes, memory_bytes: int, seconds: float) -> TwinError:
        """Return an error that describes how the child ended."""
        try:
            status = self.process.wait(timeout=_END_SECONDS)
        except subprocess.TimeoutExpired:
            return SimulationError(
                "the child process closed its pipe and did not end",
                expected=f"its end within {_END_SECONDS:g} s; run it again",
            )
        last = output.decode("utf-8", "replace").strip().rpartition("\n")[2][-300:]
        said = f"; it last wrote: {last}" if last else ""
        if status >= 0:
            return SimulationError(
                f"the child process ended with exit status {status}{said}",
                expected="an answer; what it ran must not end the process",
            )
        name = signal.Signals(-status).name
        if name == "SIGXCPU":
            return LimitError(
                "exceeded its limit of CPU time and was killed",
                expected=f"at most {seconds:g} s on each core",
            )
        if "bad_alloc" in last or "MemoryError" in last or "could not allocate" in last.lower():
            return LimitError(
                f"ran out of memory{said}", expected=f"at most {memory_bytes / 2**20:.0f} MiB"
            )
        return SimulationError(
            f"the simulator crashed ({name}){said}",
            expected="an answer; load the model with MuJoCo alone to see whether that crashes too",
        )


def _end(
    process: subprocess.Popen[bytes],
    descriptors: tuple[int, ...],
    scratch: contextlib.ExitStack,
) -> None:
    for descriptor in descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    scratch.close()


def _error_from_json(answer: Mapping[str, Any]) -> TwinError:
    """Build the error that the child has sent."""
    kind = getattr(errors, str(answer.get("kind")), None)
    if not (isinstance(kind, type) and issubclass(kind, TwinError)):
        kind = SimulationError
    line, column = answer.get("line"), answer.get("column")
    return kind(
        str(answer.get("problem")),
        path=answer.get("path"),
        line=line if isinstance(line, int) else None,
        column=column if isinstance(column, int) else None,
        where=answer.get("where"),
        value=answer.get("value"),
        unit=answer.get("unit"),
        expected=answer.get("expected"),
    )
