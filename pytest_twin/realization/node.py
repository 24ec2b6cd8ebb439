"""XML elements of a model, each with its file and line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import LimitError, ModelError


@dataclass(slots=True)
class Node:
    """One XML element of a model.

    Attributes:
        attributes: attribute -> text.
        path, line: file and 1-based line.
        text: text before the first child; only for a URDF.
    """

    tag: str
    attributes: dict[str, str]
    path: Path
    line: int
    children: list[Node] = field(default_factory=list)
    text: str = ""

    def walk(self) -> Iterator[Node]:
        """This element and all its descendants, in document order."""
        stack = [self]
        while stack:
            node = stack.pop()
            yield node
            stack.extend(reversed(node.children))

    def find(self, tag: str) -> Node | None:
        """The first child with this tag, or None."""
        return next((child for child in self.children if child.tag == tag), None)

    def all(self, tag: str) -> list[Node]:
        """All children with this tag."""
        return [child for child in self.children if child.tag == tag]

    @property
    def label(self) -> str:
        """Tag and name for messages, ``joint 'elbow'``; the tag alone without a name."""
        name = self.attributes.get("name")
        return self.tag if name is None else f"{self.tag} '{name}'"

    @property
    def place(self) -> str:
        """File and line as ``path:line``."""
        return f"{self.path}:{self.line}"

    def error(self, problem: str, attribute: str | None = None, **details: Any) -> ModelError:
        """Return a :class:`ModelError` with the place of this element."""
        return ModelError(
            problem, path=self.path, line=self.line, where=self._where(attribute), **details
        )

    def limit(self, problem: str, attribute: str | None = None, **details: Any) -> LimitError:
        """Return a :class:`LimitError` with the place of this element."""
        return LimitError(
            problem, path=self.path, line=self.line, where=self._where(attribute), **details
        )

    def _where(self, attribute: str | None) -> str:
        return self.label if attribute is None else f"{self.label}.{attribute}"

    def numbers(
        self,
        attribute: str,
        default: tuple[float, ...] | None,
        *,
        size: int | None = None,
        unit: str | None = None,
        most: float = 1e10,
    ) -> NDArray[np.float64]:
        """Parse the numbers of an attribute; ``default`` where it is absent.

        Args:
            default: values where it is absent, None where it is required.
            size: required number of values; by default that of ``default``.
            unit: unit, for error messages.
            most: largest magnitude; by default that of a state with which MuJoCo steps.

        Raises:
            ModelError: absent without a default, not numbers, not finite, a wrong number of
                values, or larger than ``most``.
        """
        text = self.attributes.get(attribute)
        size = len(default) if size is None and default is not None else size
        expected = "a finite number" if size == 1 else f"{size} finite numbers"
        expected += f" in {unit}" if unit else ""
        if text is None:
            if default is None:
                raise self.error("missing", attribute, expected=expected)
            return np.array(default, dtype=np.float64)
        try:
            values = [float(token) for token in text.split()]
        except ValueError:
            raise self.error("no number", attribute, value=text, expected=expected) from None
        if not all(math.isfinite(value) for value in values):
            raise self.error("not a finite number", attribute, value=text, expected=expected)
        if size is not None and len(values) != size:
            raise self.error("another count of numbers", attribute, value=text, expected=expected)
        if any(abs(value) > most for value in values):
            raise self.error(
                "too large",
                attribute,
                value=text,
                unit=unit,
                expected=f"at most {most:g}",
            )
        return np.array(values, dtype=np.float64)

    def number(
        self,
        attribute: str,
        default: float | None,
        *,
        unit: str | None = None,
        most: float = 1e10,
    ) -> float:
        """Parse one finite number of an attribute, as :meth:`numbers`."""
        fallback = None if default is None else (default,)
        return float(self.numbers(attribute, fallback, size=1, unit=unit, most=most)[0])
