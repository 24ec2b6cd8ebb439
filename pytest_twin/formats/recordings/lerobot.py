"""Read LeRobot data sets, versions 2.0, 2.1 and 3.0: each episode is a recording.

``meta/info.json`` describes the features and the paths of the Parquet files. Version 2 writes a
file for each episode, version 3 several episodes to a file.
https://github.com/huggingface/lerobot, ``src/lerobot/datasets/utils.py``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pytest_twin.errors import FormatError, RecordingError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.formats.recording import JointSeries, Notes, Recording
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.lerobot_calibration import MotorRange, read_calibration
from pytest_twin.formats.recordings.lerobot_units import (
    Declared,
    Positions,
    Unit,
    episodes_in_another_unit,
    unit_of,
)
from pytest_twin.formats.recordings.parquet import data_files, read_columns
from pytest_twin.formats.ros_serialization import QUANTITIES, Floats, Integers
from pytest_twin.words import list_names

INFO = "meta/info.json"
_VERSION = re.compile(r"v[23]\.\d{1,3}")
_FEATURES = {"state": "observation.state", "command": "action"}
_SUFFIXES = {
    ".pos": "position",
    ".vel": "velocity",
    ".effort": "effort",
    ".torque": "effort",
}
# Timestamps are frame / fps, rounded to single precision.
_SINGLE = 2.0**-22


class LeRobotDataset:
    """Reads the folder of a LeRobot data set."""

    kind: ClassVar[str] = "LeRobot data set"

    def reads(self, path: Path) -> bool:
        """Whether ``path`` is a folder with ``meta/info.json``."""
        return path.is_dir() and (path / INFO).is_file()

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read all episodes, in their order."""
        dataset = Dataset(path, options)
        dataset.refuse_different_units()
        return dataset.recordings(dataset.unit())


@dataclass(frozen=True)
class _Feature:
    """One vector feature of the data set, with a name and a quantity for each value."""

    column: str
    names: tuple[str, ...]
    quantities: tuple[str, ...]


class Dataset:
    """Content of a LeRobot data set.

    Attributes:
        info: content of ``info.json``.
        notes: decisions of the reader.
    """

    def __init__(self, path: Path, options: ReadingOptions) -> None:
        self.path, self.options = path, options
        self.file = path / INFO
        self.notes = Notes()
        self.info = self._read_info()
        features = self.info.get("features")
        if not isinstance(features, dict):
            raise FormatError(
                "describes no features",
                path=self.file,
                where="features",
                expected="a JSON object with " + " or ".join(_FEATURES.values()),
            )
        self.features = {
            role: self._feature(features[column], column)
            for role, column in _FEATURES.items()
            if column in features and role in options.topics
        }
        if not self.features:
            raise RecordingError(
                "no joint states and no actions",
                path=self.file,
                where="features",
                value=", ".join(map(str, features)),
                expected=" and ".join(_FEATURES.values()),
            )
        self.declared = features

    def _read_info(self) -> dict[str, Any]:
        text = decode_text(read_bytes(self.file, limits.YAML.file_bytes), self.file)
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not JSON: {str(error)[:80]}", path=self.file) from None
        if not isinstance(found, dict):
            raise FormatError(
                "not a JSON object",
                path=self.file,
                expected="an object with codebase_version, fps and features",
            )
        version = str(found.get("codebase_version"))
        if not _VERSION.fullmatch(version):
            raise FormatError(
                "an unsupported version of LeRobot's format",
                path=self.file,
                where="codebase_version",
                value=version,
                expected="v2.0 to v3.0; lerobot converts older data sets",
            )
        return found

    def _feature(self, declared: object, column: str) -> _Feature:
        shape = declared.get("shape") if isinstance(declared, dict) else None
        where = f"features.{column}"
        match shape:
            case [int() as count] if 0 < count <= limits.MCAP.joints_count:
                pass
            case _:
                raise FormatError(
                    "not a vector of joints",
                    path=self.file,
                    where=f"{where}.shape",
                    value=str(shape),
                    expected=f"[n] with n up to {limits.MCAP.joints_count}",
                )
        assert isinstance(declared, dict)
        written = _flatten(declared.get("names"))
        if len(written) != count or len(set(written)) != count:
            self.notes.add(
                column,
                f"does not name each of its {count} values: joints are numbered 0 to {count - 1}",
            )
            written = [str(place) for place in range(count)]
        names, quantities = [], []
        for name in written:
            if not name.isprintable() or len(name) > limits.CSV.name_chars:
                raise FormatError(
                    "not a usable name of a joint",
                    path=self.file,
                    where=where,
                    value=name,
                    expected=f"printable text of at most {limits.CSV.name_chars} characters",
                )
            suffix = next((s for s in _SUFFIXES if name.endswith(s) and name != s), "")
            names.append(name.removesuffix(suffix))
            quantities.append(_SUFFIXES.get(suffix, "position"))
        return _Feature(column, tuple(names), tuple(quantities))

    @cached_property
    def table(self) -> dict[str, Floats]:
        """Numbers of all frames by column, in the order of episodes and frames."""
        sizes = {f.column: len(f.names) for f in self.features.values()}
        table = read_columns(
            data_files(self.path, self.info.get("data_path"), self.file),
            {**sizes, "timestamp": 0, "frame_index": 0, "episode_index": 0},
        )
        if not len(table["episode_index"]):
            raise RecordingError(
                "no frames",
                path=self.path,
                expected="at least one frame in the files under data/",
            )
        order = np.lexsort((table["frame_index"], table["episode_index"]))
        return {name: values[order] for name, values in table.items()}

    @cached_property
    def positions(self) -> Positions:
        """The values that are positions, as recorded."""
        columns = {
            feature.column: [k for k, q in enumerate(feature.quantities) if q == "position"]
            for feature in self.features.values()
        }
        return Positions(
            {f.column: [f.names[k] for k in columns[f.column]] for f in self.features.values()},
            {column: self.table[column][:, places] for column, places in columns.items()},
        )

    def refuse_different_units(self) -> None:
        """Check that all episodes are in one unit.

        Raises:
            FormatError: some are in rad and others in degrees.
        """
        others = episodes_in_another_unit(self.positions, self.table["episode_index"])
        if others:
            raise FormatError(
                "episodes in different units, rad and degrees", path=self.path,
                value=f"episodes {list_names([str(number) for number in others])}",
                expected="one unit; convert these episodes or remove them",
            )  # fmt: skip

    def recordings(self, unit: Unit) -> list[Recording]:
        """Return the episodes, with positions of this unit in rad."""
        table = self.table
        time = self._times(table)
        episode = table["episode_index"].astype(np.int64)
        first = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
        require_at_most(
            len(first), limits.MCAP.messages_free_count, "too many episodes", path=self.path
        )
        ends = [*first[1:].tolist(), len(episode)]
        notes = tuple(str(note) for note in self.notes.all())
        return [
            self._episode(int(episode[begin]), slice(begin, end), table, time, unit, notes)
            for begin, end in zip(first.tolist(), ends, strict=True)
        ]

    def unit(self) -> Unit:
        """Return the unit of the positions, and note why.

        Raises:
            FormatError: it is not known, or the motor calibration is not one.
        """
        declared = Declared(
            asked=self.options.units,
            motors=self.motors,
            info=self.info,
            features=[self.declared[feature.column] for feature in self.features.values()],
            file=self.file,
        )
        return unit_of(declared, self.positions, self.notes)

    @cached_property
    def motors(self) -> Mapping[str, MotorRange]:
        """Calibrated range of each motor; empty without a calibration."""
        calibration = self.options.motor_calibration
        return {} if calibration is None else read_calibration(calibration)

    def _episode(
        self,
        number: int,
        rows: slice,
        table: Mapping[str, Floats],
        time: Integers,
        unit: Unit,
        notes: tuple[str, ...],
    ) -> Recording:
        series = {
            role: self._series(role, feature, table[feature.column][rows], time[rows], unit)
            for role, feature in self.features.items()
        }
        metadata = (
            {"robot_type": str(self.info["robot_type"])} if self.info.get("robot_type") else {}
        )
        role = self._role_of(number)
        if role:
            metadata["role"] = role
        return Recording(self.path / f"episode_{number:06d}", series, metadata, (), notes)

    def _series(
        self, role: str, feature: _Feature, values: Floats, time: Integers, unit: Unit
    ) -> JointSeries:
        names = tuple(name for name in dict.fromkeys(feature.names) if name not in unit.unknown)
        tables: dict[str, Floats | None] = dict.fromkeys(QUANTITIES)
        for at, (name, quantity) in enumerate(zip(feature.names, feature.quantities, strict=True)):
            if name in unit.unknown:
                continue
            table = tables[quantity]
            if table is None:
                table = tables[quantity] = np.full((len(time), len(names)), np.nan)
            recorded = values[:, at]
            if quantity == "position":
                recorded = unit.angles(name, recorded)
            elif quantity == "velocity":
                recorded = unit.velocities(name, recorded)
            table[:, names.index(name)] = recorded
        return JointSeries(
            topic=self.options.topics[role],
            names=names,
            stamp=time,
            log_time=time.copy(),
            position=tables["position"],
            velocity=tables["velocity"],
            effort=tables["effort"],
            stated=frozenset(names),
        )

    def _times(self, table: Mapping[str, Floats]) -> Integers:
        """Return (n,) times in ns, from frame / fps: stamps have steps of 8 us after 100 s."""
        written, frame = table["timestamp"], table["frame_index"]
        fps = self.info.get("fps")
        if isinstance(fps, (int, float)) and 0 < fps < 1e6:
            exact = frame / fps
            if (np.abs(written - exact) <= _SINGLE * np.abs(exact)).all():
                written = exact
        if not np.isfinite(written).all() or np.abs(written).max() > 2**33:
            raise RecordingError(
                "a timestamp that is not a time",
                path=self.path,
                where="timestamp",
                value=float(written[np.argmax(~(np.abs(written) <= 2**33))]),
                unit="s",
                expected=f"at most {2**33} s",
            )
        return np.rint(written * 1e9).astype(np.int64)

    def _role_of(self, number: int) -> str | None:
        """Return role ``fit`` or ``held_out`` if the data set has splits besides ``train``."""
        splits = self.info.get("splits")
        if not isinstance(splits, dict) or len(splits) < 2:
            return None
        for name, span in splits.items():
            first, _, last = str(span).partition(":")
            if first.isdecimal() and last.isdecimal() and int(first) <= number < int(last):
                return "fit" if name == "train" else "held_out"
        return None


def _flatten(names: object) -> list[str]:
    """Return the names of a feature, given as a list, nested lists or lists under headings."""
    if isinstance(names, str):
        return [names]
    parts = names.values() if isinstance(names, dict) else names
    if not isinstance(parts, (list, type({}.values()))):
        return []
    return [name for part in parts for name in _flatten(part)]
