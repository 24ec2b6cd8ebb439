"""Read and write the library of servos: entries of the package, and a file of the user."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError, SpecError
from pytest_twin.formats import atomic, typed, yaml

VARIABLE = "PYTEST_TWIN_SERVOS"
"""Environment variable with the path of the user's library."""
PARAMETERS: Mapping[str, tuple[str, str]] = {
    # parameter -> (unit of a hinge, attribute under fit:)
    "stiffness": ("N*m/rad", "actuator.kp"),
    "damping": ("N*m*s/rad", "actuator.kv"),
    "effort_limit": ("N*m", "actuator.forcerange"),
    "armature": ("kg*m^2", "joint.armature"),
    "friction": ("N*m", "joint.frictionloss"),
    "viscous": ("N*m*s/rad", "joint.damping"),
}
"""Parameters of a drive at the output shaft."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter of a servo at its output shaft.

    Attributes:
        value: in ``unit``.
        unit: SI unit.
        ci95: 95 % interval, or the range over several servos; empty if unknown.
        how: how the value and its interval were found.
    """

    value: float
    unit: str
    ci95: tuple[float, ...] = ()
    how: str = ""


@dataclass(frozen=True, slots=True)
class Servo:
    """One identified servo.

    Attributes:
        id: name in the library.
        maker, model: as on the data sheet.
        law: law of the drive, with the names of the parameters.
        conditions: supply, firmware gains, load and temperature under which the values hold.
        drive: one of ``PARAMETERS`` -> estimate.
        findings: effects beyond the drive's law: ``effect``, ``confidence``, ``parameters``.
        held_out: what the error on held-out recordings was.
        evidence: ``recordings``, ``digest``, ``command``, ``version``.
        notes: what a user must know.
    """

    id: str
    maker: str
    model: str
    law: str
    conditions: dict[str, str]
    drive: dict[str, Estimate]
    evidence: dict[str, str]
    findings: list[dict[str, Any]] = field(default_factory=list)
    held_out: str = ""
    notes: list[str] = field(default_factory=list)

    def fit(self, actuator: str, joint: str) -> dict[str, dict[str, dict[str, Any]]]:
        """Values of one drive for ``fit:`` in ``twin.yaml``.

        Args:
            actuator, joint: names in the model.
        """
        out: dict[str, dict[str, dict[str, Any]]] = {
            "actuator": {actuator: {}},
            "joint": {joint: {}},
        }
        names = {"actuator": actuator, "joint": joint}
        for parameter, (_, attribute) in PARAMETERS.items():
            if parameter in self.drive:
                family, _, name = attribute.partition(".")
                value = self.drive[parameter].value
                out[family][names[family]][name] = (
                    [-value, value] if name == "forcerange" else value
                )
        return out


def user_library() -> Path:
    """File of the user's own servos."""
    given = os.environ.get(VARIABLE)
    return Path(given) if given else Path.home() / ".config" / "pytest-twin" / "servos.yaml"


def servos() -> dict[str, Servo]:
    """All servos by id; those of the user replace those of the package.

    Raises:
        FormatError: an entry has wrong fields.
    """
    path = user_library()
    return package_servos() | (read_library(path) if path.is_file() else {})


def package_servos() -> dict[str, Servo]:
    """Servos of the package by id.

    Raises:
        FormatError: an entry has wrong fields.
    """
    found = {}
    folder = resources.files("pytest_twin.servos").joinpath("entries")
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        path = Path(entry.name)
        servo = _servo(yaml.loads(entry.read_text("utf-8"), path).data, path)
        found[servo.id] = servo
    return found


def read_library(path: Path) -> dict[str, Servo]:
    """Servos of a library file by id.

    Raises:
        FormatError: the file has wrong fields.
    """
    data = yaml.load(path).data
    if (
        not isinstance(data, dict)
        or data.get("schema") != 1
        or not isinstance(data.get("servos"), list)
    ):
        raise FormatError(
            "not a library of servos", path=path, where="schema, servos",
            expected="schema: 1 and a list of servos, as servo add writes them",
        )  # fmt: skip
    entries = [_servo(entry, path) for entry in data["servos"]]
    return {servo.id: servo for servo in entries}


def find(name: str) -> Servo:
    """A servo by its id.

    Raises:
        SpecError: there is none.
    """
    known = servos()
    if name not in known:
        raise SpecError(
            "no such servo", where="--servo", value=name, expected=f"one of {', '.join(known)}"
        )
    return known[name]


def add(servo: Servo, path: Path) -> None:
    """Add a servo to a library file, or replace the one with its id.

    Raises:
        FormatError: the file has wrong fields.
    """
    known = read_library(path) if path.is_file() else {}
    known[servo.id] = servo
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, library_text(known))


def library_text(known: Mapping[str, Servo]) -> str:
    """Text of a library file."""
    data = {"schema": 1, "servos": [typed.plain(servo) for servo in known.values()]}
    return yaml.dump(data)


def _servo(data: object, path: Path) -> Servo:
    try:
        servo = typed.build(data, Servo)
    except typed.FieldError as error:
        raise FormatError(
            "wrong field of a servo", path=path, where=error.where, value=error.value,
            expected=error.expected,
        ) from None  # fmt: skip
    for name, estimate in servo.drive.items():
        unit = PARAMETERS.get(name, ("", ""))[0]
        if not unit or estimate.unit != unit or not estimate.value >= 0.0:
            raise FormatError(
                "wrong parameter of a servo", path=path, where=f"{servo.id}.drive.{name}",
                value=f"{estimate.value} {estimate.unit}",
                expected=f"a number of at least 0 in {unit}" if unit else ", ".join(PARAMETERS),
            )  # fmt: skip
    return servo


def page(servo: Servo) -> str:
    """The servo as a Markdown page."""
    rows = [
        f"| {name} | {e.value:.4g} | {_interval(e)} | {e.unit} | {e.how} |"
        for name, e in servo.drive.items()
    ]
    findings = [
        f"- `{item.get('effect')}`, confidence {item.get('confidence')}: {item.get('parameters')}"
        for item in servo.findings
    ]
    lines = [
        f"# {servo.maker} {servo.model}",
        "",
        f"`pytest-twin init ROBOT --servo {servo.id}` writes drives with these values.",
        "",
        f"Law: {servo.law}.",
        "",
        "| parameter | value | 95 % interval | unit | found by |",
        "|---|---|---|---|---|",
        *rows,
        "",
        *(["Beyond this law:", "", *findings, ""] if findings else []),
        "Conditions:",
        "",
        *(f"- {name}: {text}" for name, text in servo.conditions.items()),
        "",
        *([f"Held out: {servo.held_out}", ""] if servo.held_out else []),
        *(f"- {note}" for note in servo.notes),
        *([""] if servo.notes else []),
        "Evidence:",
        "",
        *(f"- {name}: `{text}`" for name, text in servo.evidence.items()),
    ]
    return "\n".join(lines) + "\n"


def _interval(estimate: Estimate) -> str:
    return " to ".join(f"{end:.4g}" for end in estimate.ci95) or "unknown"
