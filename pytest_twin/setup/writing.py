"""Write the files of a new twin: ``twin.yaml``, first goldens, schemas for editors, git files."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from pytest_twin.checks import kinds
from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic, yaml
from pytest_twin.formats.file_names import portable_names
from pytest_twin.gate.schema import golden_schema, modeline
from pytest_twin.gate.specs import GOLDEN_FOLDER
from pytest_twin.setup import unfinished
from pytest_twin.setup.asset_files import ASSET
from pytest_twin.twin import FILE_NAME

_SCHEMAS = "schemas"
_IGNORED = ".gitignore"
_ATTRIBUTES = ".gitattributes"
_WRITTEN_NAMES = (FILE_NAME, ASSET, _SCHEMAS, GOLDEN_FOLDER, ".twin", _IGNORED, _ATTRIBUTES)
_BYTE_EXACT = """\
# Digests of goldens, traces, keys and releases are over bytes: git must not convert line endings.
* -text
"""
_RULES = """\
# Dependencies that are in no file. Change an id when the part changes: its goldens become stale.
# parts:
#   firmware: {id: "3.10", affects: {kinds: [replay, step, frequency_response]}}
#   table: {id: steel-2024, affects: {kinds: [contact]}}
# controllers, payloads, calibration and fit: see docs/twin.md
"""


@contextmanager
def all_or_nothing(folder: Path) -> Iterator[None]:
    """Delete the written files of a twin in ``folder`` if the block raises an exception.

    A twin whose block was killed is refused by every command; :func:`set_aside` clears it away.
    """
    there = folder.is_dir()
    before = frozenset(_written_files(folder))
    try:
        with unfinished.marked(folder, before):
            yield
    except BaseException:
        for path in _written_files(folder):
            if path not in before:
                with suppress(OSError):  # A folder with other files.
                    path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        if not there:
            with suppress(OSError):
                folder.rmdir()
        raise


def set_aside(folder: Path) -> Path | None:
    """Move what an init that was killed has written out of the way; None if there was none.

    Raises:
        SpecError: an init is running in this folder.
        PathError: a file cannot be moved.
    """
    return unfinished.set_aside(folder, _written_files(folder))


def _written_files(folder: Path) -> Iterator[Path]:
    """All files and folders at the paths that this module writes; contents before their folder."""
    for name in _WRITTEN_NAMES:
        for here, folders, files in os.walk(folder / name, topdown=False):
            yield from (Path(here) / inner for inner in (*files, *folders))
        if (folder / name).exists():
            yield folder / name


@dataclass(frozen=True, slots=True)
class FirstTwin:
    """Content of a first ``twin.yaml``.

    Attributes:
        source: the supplier's files.
        roots: name -> folder that may contain referenced files.
        tcp: frame of the tool, or None.
        inertia_repairs: link -> inertia (6,) [kg*m^2] that replaces an inconsistent one.
        motors: actuator -> ``hinge`` or ``slide``, for a URDF, which states no controller.
        reading: options of recordings, such as ``topics``, ``joints`` and ``clock``.
        critical: ids of the critical findings of the audit.
        alike: groups of joints that may have the same motor.
        excitation: section ``excitation:`` without values, as YAML; empty without a movable joint.
        servo: id of the servo of all drives, or empty.
        servo_fit: values of its drives, as under ``fit:``.
        servos: section ``servos:`` with their intervals.
    """

    name: str
    model: Path
    source: Iterable[Path]
    roots: Mapping[str, Path]
    tcp: str | None
    inertia_repairs: Mapping[str, Sequence[float]]
    motors: Mapping[str, str]
    reading: Mapping[str, Any]
    critical: Sequence[str] = ()
    alike: Sequence[Sequence[str]] = ()
    excitation: str = ""
    servo: str = ""
    servo_fit: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    servos: Sequence[Mapping[str, Any]] = ()


def write_twin_file(folder: Path, first: FirstTwin) -> Path:
    """Write ``twin.yaml``, and return its path."""
    motors, inertia_repairs = first.motors, first.inertia_repairs
    content: dict[str, Any] = {
        "schema": 1,
        "name": first.name,
        "model": first.model.relative_to(folder).as_posix(),
    }
    source = sorted(_relative_path(folder, path) for path in first.source)
    if source:
        content["source"] = source
    if first.roots:
        content["roots"] = {
            name: _relative_path(folder, root) for name, root in sorted(first.roots.items())
        }
    content |= first.reading
    if first.tcp is not None:
        content["tcp"] = first.tcp
    if inertia_repairs:
        # Stated explicitly, because the supplier's inertias are not physically consistent.
        content["fit"] = {
            "id": "inertia-repair",
            "body": {
                link: {"inertia": [float(f"{v:.9g}") for v in values]}
                for link, values in inertia_repairs.items()
            },
        }
    if first.servo:
        repaired = content.get("fit", {}).get("body")
        content["fit"] = {
            "id": f"servo-{first.servo}",
            **({"body": repaired} if repaired else {}),
            **{family: dict(values) for family, values in first.servo_fit.items()},
        }
    if first.servos:
        content["servos"] = [dict(servo) for servo in first.servos]
    content["release"] = {"valid_days": 90}
    head = modeline(f"{_SCHEMAS}/twin.schema.json")
    path = folder / FILE_NAME
    is_open = bool(motors) and not first.servo
    servos = _servo_lines(motors, with_fit=bool(inertia_repairs)) if is_open else ""
    atomic.write_text(
        path,
        f"{head}\n{yaml.dump(content)}{servos}{_motor_types(first.alike)}{_excitation(first.excitation)}"
        f"{_acceptance(first.critical)}{_RULES}",
    )
    return path


def _motor_types(alike: Sequence[Sequence[str]]) -> str:
    """Commented lines that group joints with equal motors; empty without any."""
    if not alike:
        return ""
    groups = "".join(
        f"#   type_{number}: {json.dumps(list(joints), ensure_ascii=False)}\n"
        for number, joints in enumerate(alike, start=1)
    )
    return (
        "# These joints have equal armatures and effort limits. If their motors are of one type,\n"
        "# take the # off these lines and write the type: diagnose --before then says whether one\n"
        "# joint changed or the type.\n"
        f"# motors:\n{groups}"
    )


def _excitation(section: str) -> str:
    """Commented lines with the limits that a motion of the robot needs; empty without any."""
    if not section:
        return ""
    lines = "".join(f"# {line}\n" for line in section.splitlines())
    return (
        "# For short check motions to record at every release, a qualified person takes the # off\n"
        "# these lines and states the limits; the model's own are given where it has them. Then:\n"
        "# pytest-twin excite twin.yaml --check --out check\n"
        f"{lines}"
    )


def _acceptance(critical: Sequence[str]) -> str:
    """Commented lines with which a person accepts critical findings; empty without any."""
    if not critical:
        return ""
    listed = "".join(
        f"#       - {json.dumps(finding, ensure_ascii=False)}\n" for finding in critical
    )
    return (
        "# The audit finds these faults in the model. Correct the file; or, to release it with\n"
        "# some of them, take the # off these lines, delete the others, write reason and owner:\n"
        f"# accepted_findings:\n#   - findings:\n{listed}"
        "#     reason:  # why this twin may be released with them\n"
        "#     owner:  # who answers for it\n"
    )


def _relative_path(folder: Path, path: Path) -> str:
    """Path as text for ``twin.yaml``: relative for a file inside the twin's folder."""
    return (path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix()


def _servo_lines(motors: Mapping[str, str], *, with_fit: bool) -> str:
    """Commented lines for servo gains, into which the user writes the gains."""
    head = (
        "# No controller: the motors take torques, and nothing holds a pose. To make servos of\n"
        "# them, take the # off these lines and put the controller's gains in place of the units:\n"
    )
    where = "# these lines go below fit: above\n" if with_fit else "# fit:\n#   id: servo-gains\n"
    units = {"hinge": "kp: N*m/rad, kv: N*m*s/rad", "slide": "kp: N/m, kv: N*s/m"}
    lines = [
        f"#     {yaml.dump({name: 0}).rpartition(':')[0]}: {{{units[kind]}}}\n"
        for name, kind in motors.items()
    ]
    return f"{head}{where}#   actuator:\n{''.join(lines)}"


def write_specs(folder: Path, specs: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Write first goldens to ``golden/<kind>/<name>.yaml``, with portable file names.

    The ``name`` of a spec is its subject, such as a joint; its ``notes`` become comments.

    Raises:
        SpecError: a golden exists already.
    """
    places = spec_places(folder, specs)
    for path in places:
        if path.exists():
            raise SpecError("the golden exists already", path=path, expected="a new folder")
    for path, spec in places.items():
        write_spec(folder, path, spec)
    return list(places)


def spec_places(folder: Path, specs: Sequence[Mapping[str, Any]]) -> dict[Path, Mapping[str, Any]]:
    """Return the file of each spec in a twin's folder -> the spec."""
    # In a twin's folder that is itself named golden, all folders have specs.
    base = folder if folder.name == GOLDEN_FOLDER else folder / GOLDEN_FOLDER
    names: dict[str, list[str]] = {}
    for spec in specs:
        names.setdefault(str(spec["kind"]), []).append(str(spec["name"]))
    files = {kind: portable_names(of_kind) for kind, of_kind in names.items()}
    return {
        base / spec["kind"] / f"{files[spec['kind']][spec['name']]}.yaml": spec for spec in specs
    }


def write_spec(folder: Path, path: Path, spec: Mapping[str, Any]) -> None:
    """Write one spec of the twin in ``folder``, without recorded values; replace what is there."""
    body = {"schema": 1, **spec}
    del body["name"]
    notes = body.pop("notes", [])
    path.parent.mkdir(parents=True, exist_ok=True)
    schema = folder / _SCHEMAS / "golden.schema.json"
    head = f"{modeline(os.path.relpath(schema, path.parent))}\n" if schema.is_file() else ""
    comments = "".join(f"{line}\n" for note in notes for line in _comment(note))
    atomic.write_text(path, f"{head}{comments}{yaml.dump(body)}")


def _comment(note: str) -> list[str]:
    return textwrap.wrap(
        " ".join(note.split()),
        width=100,
        initial_indent="# ",
        subsequent_indent="#   ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def write_schemas(folder: Path) -> None:
    """Write the schemas of ``twin.yaml`` and of goldens of all installed kinds, for editors."""
    (folder / _SCHEMAS).mkdir(exist_ok=True)
    shipped = resources.files("pytest_twin") / "schemas" / "twin.schema.json"
    atomic.write_text(folder / _SCHEMAS / "twin.schema.json", shipped.read_text("utf-8"))
    schema = json.dumps(golden_schema(kinds()), indent=2) + "\n"
    atomic.write_text(folder / _SCHEMAS / "golden.schema.json", schema)


def write_git_files(folder: Path) -> list[str]:
    """Write ``.gitignore`` and ``.gitattributes``, and return notes.

    Digests of traces, assets and releases are of bytes, so that git must not convert line endings.
    """
    if not (folder / _IGNORED).exists():
        atomic.write_text(folder / _IGNORED, ".twin/\n")
    path = folder / _ATTRIBUTES
    if not path.exists():
        atomic.write_text(path, _BYTE_EXACT)
        return []
    lines = path.read_text("utf-8", "replace").splitlines()
    if any(line.split() == ["*", "-text"] for line in lines):
        return []
    return [
        f"{path} is not changed: add the line '* -text', because goldens and releases fail if git "
        "converts line endings"
    ]
