"""Every error that a user can cause, as one line that says where, what, and what was expected."""

from __future__ import annotations

from pathlib import Path


class TwinError(Exception):
    """Something that a user can correct.

    Args:
        problem: what is wrong, in words, without a final stop.
        path: the file at fault.
        line: 1-based line in that file.
        column: 1-based column in that line.
        where: the field at fault, dotted (``tolerance.position``), or an element, ``link 'wrist'``.
        value: the offending value.
        unit: the unit of ``value``.
        expected: what would have been right.
    """

    # By keyword, and each of them one part of the message.
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
        # One line always: what comes from a file may carry line breaks or terminal escapes.
        return "".join(c if c.isprintable() else "�" for c in text)

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.problem, self.__dict__))


def _rebuild(cls: type[TwinError], problem: str, state: dict[str, object]) -> TwinError:
    error = cls.__new__(cls)
    Exception.__init__(error, problem)
    error.__dict__.update(state)
    return error


class FormatError(TwinError):
    """A file that cannot be read as what it claims to be."""


class LimitError(FormatError):
    """A file beyond a declared bound of size, depth, count, time or memory."""


class PathError(TwinError):
    """A path that leaves its declared roots, or a link where none may be."""


class SpecError(TwinError):
    """A ``twin.yaml`` or a golden spec that is well-formed but means nothing."""


class UnwrittenToleranceError(SpecError):
    """A golden whose tolerance is still blank, because nothing states what the task allows."""


class ModelError(TwinError):
    """A robot model that no simulator should be asked to step."""


class RecordingError(TwinError):
    """A recording that cannot be made into a trial."""


class SimulationError(TwinError):
    """A simulation that diverged, crashed, or ran past its bounds."""


class ReleaseError(TwinError):
    """A release that may not be signed, or does not hold."""
