"""Errors that a user can cause; each is one line with the place, the problem and what to expect."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any


class TwinError(Exception):
    """Base class of errors that a user can correct.

    Args:
        problem: description of the problem, without a final full stop.
        path: the file with the problem.
        line: 1-based line in that file.
        column: 1-based column in that line.
        where: the wrong field, dotted (``tolerance.position``), or an element, ``link 'wrist'``.
        unit: the unit of ``value``.
        expected: description of a valid value.
    """

    # Each keyword is one part of the message, and a caller names those that it knows. An object for
    # file, line and column would only make the several hundred callers longer.
    def __init__(  # noqa: PLR0913
        self,
        problem: str,
        *,
        path: Path | str | None = None,
        line: int | None = None,
        column: int | None = None,
        where: str | None = None,
        value: object = None,
        unit: str | None = None,
        expected: str | None = None,
    ) -> None:
        self.problem = problem
        self.path = None if path is None else Path(path)
        self.line = line
        self.column = column
        self.where = where
        self.value = value
        self.unit = unit
        self.expected = expected
        super().__init__(problem)

    def __str__(self) -> str:
        place = "" if self.path is None else str(self.path)
        if self.line is not None:
            place += f":{self.line}" + ("" if self.column is None else f":{self.column}")
        head = ": ".join(part for part in (place, self.where, self.problem) if part)
        tail = []
        if self.value is not None:
            shown = repr(self.value) if isinstance(self.value, str) else str(self.value)
            shown = shown if len(shown) <= 120 else shown[:117] + "..."
            tail.append(f"got {shown}" + (f" {self.unit}" if self.unit else ""))
        if self.expected is not None:
            tail.append(f"expected {self.expected}")
        text = head + (f" ({'; '.join(tail)})" if tail else "")
        # A value from a file may contain line breaks or terminal escapes; the message is one line.
        return "".join(c if c.isprintable() else "�" for c in text)

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.problem, self.__dict__))


def _rebuild(cls: type[TwinError], problem: str, state: dict[str, object]) -> TwinError:
    error = cls.__new__(cls)
    Exception.__init__(error, problem)
    error.__dict__.update(state)
    return error


class FormatError(TwinError):
    """A file that does not follow its format."""


class PointerError(FormatError):
    """A pointer of Git LFS, or a link written as text, in place of a file."""


class LimitError(FormatError):
    """A file that exceeds a limit of size, depth, count, time or memory."""


def require_at_most(
    value: float, most: float, problem: str, *, unit: str | None = None, **place: Any
) -> None:
    """Check a size or count against its limit.

    Args:
        problem: description of a larger one, such as ``too many rows``.
        place: ``path``, ``line`` and ``where`` of the error.

    Raises:
        LimitError: ``value`` is larger than ``most``.
    """
    if value > most:
        expected = f"at most {most}" + (f" {unit}" if unit else "")
        raise LimitError(problem, value=value, unit=unit, expected=expected, **place)


class PathError(TwinError):
    """A path outside its declared root folders, or a symbolic link where none is allowed."""


DISK_ERRORS = frozenset({errno.ENOSPC, errno.EROFS, errno.EDQUOT})
"""Errors of the operating system for a full or read-only disk."""


def of_system(error: OSError) -> PathError:
    """Error for a refusal of the operating system, with its own words and the file."""
    # A copy that fails names its target second.
    return PathError(f"{error.strerror or error}", path=error.filename2 or error.filename)


def cannot_write(error: OSError, path: Path | str | None = None) -> PathError:
    """Error for a write that the operating system refuses, such as on a full or read-only disk.

    Args:
        error: error of the system; it names the file unless ``path`` does.
        path: the file or folder.
    """
    return PathError(
        f"cannot be written: {error.strerror or error}",
        path=path or error.filename2 or error.filename,
    )


class SpecError(TwinError):
    """A ``twin.yaml``, golden spec or request that is well-formed but not valid."""


class UnwrittenToleranceError(SpecError):
    """A golden without a tolerance: ``init`` left it blank because only the user knows the task."""


class ModelError(TwinError):
    """A robot model that cannot be simulated."""


class RecordingError(TwinError):
    """A recording that cannot be converted to a trial."""


class SimulationError(TwinError):
    """A simulation that diverged, crashed, or exceeded its limits."""


class ReleaseError(TwinError):
    """A release that may not be signed, or whose verification fails."""
