"""A row of the yardstick: a problem with a truth, and how long a command may take to answer."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

Command = Literal["diagnose", "identify"]
LIMITS: Mapping[str, tuple[str, ...]] = {
    "none": ("--seconds", "0"),
    "default": (),
    "45s": ("--seconds", "45"),
    "60s": ("--seconds", "60"),
    "120s": ("--seconds", "120"),
}
"""Name of a time limit -> options of the command. A user's default is the command's own."""


class MissingInputError(Exception):
    """The inputs of a problem are not on this machine; the message says how to get them."""


@dataclass(frozen=True)
class Inputs:
    """Files of a problem, and what is true.

    Attributes:
        model: model, ``twin.yaml``, or the folder of one.
        fit, held_out: recordings; with no ``held_out`` their metadata say the roles.
        truth: as in the truth files of blind cases (``family_score.py``); without ``effects`` if
            nobody knows what is true.
        others: recordings of the same robot that no fit sees, on which the written model is
            replayed.
    """

    model: Path
    fit: Sequence[Path]
    held_out: Sequence[Path] = ()
    truth: Mapping[str, Any] = field(default_factory=dict)
    others: Sequence[Path] = ()

    def arguments(self) -> list[str]:
        """Return the positional arguments and ``--held-out`` of the command."""
        held_out = ["--held-out", *map(str, self.held_out)] if self.held_out else []
        return [str(self.model), *map(str, self.fit), *held_out]

    def digest(self) -> str:
        """Return the SHA-256 of the truth and of all files, independent of where they are."""
        total = hashlib.sha256(json.dumps(self.truth, sort_keys=True).encode())
        model = self.model
        beside = [model] if model.suffix != ".yaml" else sorted(
            p for p in model.parent.iterdir() if p.suffix in (".yaml", ".xml", ".urdf")
        )  # fmt: skip
        for role, files in (
            ("model", beside), ("fit", self.fit), ("held_out", self.held_out),
            ("others", self.others),
        ):  # fmt: skip
            for file in files:
                content = hashlib.sha256(file.read_bytes()).hexdigest()
                total.update(f"{role} {file.name} {content}\n".encode())
        return total.hexdigest()


@dataclass(frozen=True)
class Problem:
    """What a command has to answer.

    Attributes:
        name: ``family/case``.
        command: the command that answers it.
        write: writes or finds the inputs; gets an empty folder of its own.
        limits: time limits with which it is answered; a row for each.
    """

    name: str
    command: Command
    write: Callable[[Path], Inputs]
    limits: Sequence[str] = ("none", "default", "60s", "120s")

    @property
    def family(self) -> str:
        """The family, over which answers are pooled."""
        return self.name.partition("/")[0]


def outside(variable: str, *parts: str) -> Path:
    """Return a folder or file below the folder that an environment variable names.

    Raises:
        MissingInputError: the variable is not set, or there is no such folder or file.
    """
    folder = os.environ.get(variable)
    if not folder:
        raise MissingInputError(f"set {variable} to the folder that has {'/'.join(parts)}")
    path = Path(folder, *parts)
    if not path.exists():
        raise MissingInputError(f"{variable}: no {'/'.join(parts)} in {folder}")
    return path
