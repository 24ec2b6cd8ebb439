"""Inputs that a record was made from: parts of a model, conditions of its recordings, and files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import FormatError
from pytest_twin.formats import typed
from pytest_twin.servos.prior import contents_of
from pytest_twin.staleness import Model, joint_calibration, twin_parts
from pytest_twin.twin import JointCalibration, Pose, Twin

_STATED_FIT = "fit:"
"""Prefix of the parts with values of tables above the record under ``fit:``."""
EARLIER_RECORD = "fitted:"
"""The same for records above it."""
_LAYERS_OF_SIMULATION = (
    "collision", "mesh", "hfield", "contact", "geom", "limit", "option:integration",
)  # fmt: skip
"""Layers without effect on the efforts along a given motion."""
# Family under ``fit:`` -> layers of the parts that its values change.
_LAYERS_OF_FAMILY: Mapping[str, tuple[str, ...]] = {
    "body": ("inertia", "kinematics"),
    "joint": ("joint",),
    "actuator": ("actuator",),
}


@dataclass(frozen=True, slots=True)
class Uses:
    """Parts of a twin that an estimation uses.

    Attributes:
        joints: joints whose motion it explains; all parts that affect the motion are used.
        frames: frames whose pose it explains; the kinematics up to them are used.
        simulated: whether the motion of ``joints`` was simulated, with contacts and stops.
        everything: whether all parts of the model are used.
        controllers, payloads: names of those under which its recordings were made.
        measures_zeros: whether it measures the zeros of the joints, so that stated ones do not
            matter.
        section: section of ``twin.yaml`` that states the task: ``ranges`` or ``budget``.
    """

    joints: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()
    simulated: bool = True
    everything: bool = False
    controllers: tuple[str, ...] = ()
    payloads: tuple[str, ...] = ()
    measures_zeros: bool = False
    section: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields that differ from their defaults, JSON-able."""
        default = typed.plain(Uses())
        return {name: v for name, v in typed.plain(self).items() if v != default[name]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Uses:
        """Build from what :meth:`to_json` returned.

        Raises:
            ValueError: unknown fields, or values of another type.
        """
        unknown = set(data) - set(cls.__slots__)
        if unknown:
            raise ValueError(min(unknown))
        return typed.build(data, cls)

    def model_parts(self, structure: Structure) -> Iterator[str]:
        """Ids, without the name of the realization, of the parts of the model that are used."""
        ids: set[str] = set()
        if self.everything:
            ids |= structure.everything()
        if self.frames:
            ids |= structure.chain(self.frames)
        if self.joints:
            ids |= structure.dynamics(self.joints) | structure.effects()
        # The text of the file is not an input, only what the compiled model has of it.
        for ident in ids & structure.part_ids - {f"{structure.realization}/elements"}:
            name = ident.removeprefix(f"{structure.realization}/")
            of_simulation = {name, name.partition(":")[0]} & set(_LAYERS_OF_SIMULATION)
            if self.everything or self.simulated or not of_simulation:
                yield name


@dataclass(frozen=True, slots=True)
class Basis:
    """Inputs of a record at the time when it was made.

    Attributes:
        model: model file, relative to the record's folder; empty if none was used.
        has_twin: whether a ``twin.yaml`` was given, not the model alone.
        uses: parts that were used.
        parts: id, without the name of a realization -> content.
        files: name of an input file -> (path relative to the record's folder, content digest).
    """

    model: str
    has_twin: bool
    uses: Uses
    parts: Mapping[str, Part]
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values, for ``basis`` of a record."""
        return {
            "model": self.model,
            "has_twin": self.has_twin,
            "uses": self.uses.to_json(),
            "parts": {ident: part.content for ident, part in sorted(self.parts.items())},
            "files": {
                name: {"file": file, "digest": digest}
                for name, (file, digest) in self.files.items()
            },
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], path: Path) -> Basis:
        """Read ``basis`` of the record at ``path``.

        Raises:
            FormatError: fields are missing or of another type.
        """
        try:
            parts = data["parts"]
            if not all(isinstance(content, Mapping) for content in parts.values()):
                raise ValueError("parts")
            return cls(
                model=str(data["model"]),
                has_twin=bool(data["has_twin"]),
                uses=Uses.from_json(data["uses"]),
                parts={ident: Part(ident, content) for ident, content in parts.items()},
                files={
                    name: (str(stated["file"]), str(stated["digest"]))
                    for name, stated in data["files"].items()
                },
            )
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise FormatError(
                f"a field is missing or unusable: {error}",
                path=path,
                where="basis",
                expected="the inputs as pytest-twin writes them",
            ) from None


def input_parts(
    uses: Uses, source: Model, twin: Twin | None, *, has_twin: bool = True
) -> dict[str, Part]:
    """Return the parts that an estimation uses: part id -> part.

    Args:
        source: parts and structure of the model, before any record replaces its values; the
            record cannot hide a change of these values.
        twin: the twin with only the records that the estimation was given; None without a twin.
        has_twin: whether its recordings are read as ``twin.yaml`` states.
    """
    structure = source.structure
    contents: dict[str, Mapping[str, Any]] = {
        name: source.parts[f"{structure.realization}/{name}"].content
        for name in uses.model_parts(structure)
    }
    calibrated = {} if twin is None or twin.calibration is None else twin.calibration.joints
    for joint in _joints(uses, structure):
        content = joint_calibration(calibrated.get(joint, JointCalibration()))
        if uses.measures_zeros and not has_twin:
            content = {key: value for key, value in content.items() if key in ("sign", "scale")}
        contents[f"calibration:{joint}"] = content
    if uses.joints or uses.everything:
        # Only the direction of gravity matters, not the place of the base.
        base = None if twin is None or twin.calibration is None else twin.calibration
        pose = None if base is None else base.transform_world_to_base
        contents["base:calibration"] = {"quaternion": list((pose or Pose()).quaternion)}
    if twin is not None:
        known = contents_of(twin.servos)
        contents |= {f"servo:{joint}": known[joint] for joint in uses.joints if joint in known}
        stated = twin_parts(twin, lambda file: None)
        for layer, names in (("controller", uses.controllers), ("payload", uses.payloads)):
            for name in names:
                if f"{layer}:{name}" in stated:
                    contents[f"{layer}:{name}"] = stated[f"{layer}:{name}"].content
        # Frames are those of the model alone, without its fits.
        if has_twin and (uses.joints or uses.everything):
            contents["topics:recordings"] = stated["topics:recordings"].content
            contents.update(_earlier_values(twin, frozenset(contents)))
        if uses.section:
            contents[f"section:{uses.section}"] = _section(twin, uses.section)
    return {ident: Part(ident, content) for ident, content in contents.items()}


def _section(twin: Twin, name: str) -> dict[str, Any]:
    """What a section of ``twin.yaml`` states about the task of a result."""
    if name == "ranges":
        tolerances = [asdict(tolerance) for tolerance in twin.ranges.tolerances]
        return {"share": twin.ranges.share, "tolerance": tolerances}
    budget = twin.budget
    return {
        "frame": budget.frame or twin.tcp,
        "poses [rad or m]": [dict(pose) for pose in budget.poses],
        "position [m]": budget.position,
        "rotation [rad]": budget.rotation,
    }


def _joints(uses: Uses, structure: Structure) -> Sequence[str]:
    if uses.everything:
        return tuple(structure.joint_body)
    names = {name for frame in uses.frames for name in _chain_joints(frame, structure)}
    return sorted(names | (set(uses.joints) & structure.joint_body.keys()))


def _chain_joints(frame: str, structure: Structure) -> Iterator[str]:
    bodies = {
        body
        for end in (structure.frame_body.get(frame), frame)
        if end in structure.body_parent
        for body in structure.ancestors(str(end))
    }
    yield from (joint for joint, body in structure.joint_body.items() if body in bodies)


def _earlier_values(twin: Twin, used: Collection[str]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Values of each entry of ``fit:`` that replace values of used parts."""
    superseded = {name for table in twin.fit_tables for name in table.supersedes}
    records = {entry.record.id for entry in twin.fits}
    for table in twin.fit_tables:
        if table.id in superseded:
            continue
        content: dict[str, Any] = {"option": dict(table.option)} if table.option else {}
        for family, elements in table.patches.items():
            layers = _LAYERS_OF_FAMILY.get(family)
            values = {
                name: dict(patch)
                for name, patch in elements.items()
                if layers is None or any(f"{layer}:{name}" in used for layer in layers)
            }
            content |= {family: values} if values else {}
        yield f"{EARLIER_RECORD if table.id in records else _STATED_FIT}{table.id}", content
