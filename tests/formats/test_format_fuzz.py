"""Readers raise only typed errors with printable messages for arbitrary bytes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from bag_files import write_bag
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap_files import BARE, mcap, sines

from pytest_twin.errors import TwinError
from pytest_twin.formats import schema, xml, yaml
from pytest_twin.formats.mcap import read_recording
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.csv import CsvFile
from pytest_twin.formats.recordings.rosbag2 import Rosbag2Folder
from pytest_twin.formats.recordings.sqlite import SqliteFile
from pytest_twin.formats.trace import read_trace

SPEC = b"""\
# a spec
schema: 1
kind: fk
target: {frames: [tcp, "wr\xc3\xa9"], pose: {elbow: -1.5e-3}}
tolerance:
  position: 0.5 mm
  note: |
    two
    lines
# --- recorded by pytest --twin-update; a person reads this as a diff ---
expected:
  - [0.0, 1.0]
"""
URDF = b"""\
<?xml version="1.0" encoding="utf-8"?>
<!-- <!DOCTYPE none> -->
<robot name="r"><link name="a"><inertial><mass value="1.5"/></inertial></link>
<joint name="j" type="revolute"><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint></robot>
"""
TRACE = b"time [s],position:elbow [rad],effort [N*m]\n0.0,0.5,-1e-3\n0.1,0.25,2\n0.2,1,3.5\n"
TWIN_SCHEMA = schema.load_schema("twin.schema.json")


def read_yaml(path: Path) -> None:
    document = yaml.load(path)
    text = yaml.read_text(path)
    try:
        schema.validate(document, TWIN_SCHEMA, path)
    finally:
        yaml.rewrite_recorded(text, {"expected": [1.0]}, path)


def read_xml(path: Path) -> None:
    xml.parse(path)


CSV = b"time,a.position,b.command,note\n0.0,1,2e-3,x\n0.01,-1.5,nan,y\n0.02,,3,z\n"
METADATA = b"""\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths:
    - a.mcap
  topics_with_message_count:
    - topic_metadata: {name: /joint_states, type: sensor_msgs/msg/JointState}
      message_count: 5
  custom_data: {role: fit}
"""


def read_csv(path: Path) -> object:
    return CsvFile().read(path, ReadingOptions())


def read_sqlite(path: Path) -> object:
    return SqliteFile().read(path, ReadingOptions())


def read_metadata(path: Path) -> object:
    folder = path.with_name("bag")
    folder.mkdir(exist_ok=True)
    (folder / "a.mcap").write_bytes(mcap(sines(5)))
    path.replace(folder / "metadata.yaml")
    try:
        return Rosbag2Folder().read(folder, ReadingOptions())
    except TwinError as error:
        if error.path in (folder / "metadata.yaml", folder):
            error.path = path
        raise


def sqlite_bag() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return (write_bag(Path(folder) / "bag", sines(5)) / "bag.db3").read_bytes()


READERS: dict[str, tuple[Callable[[Path], object], list[bytes]]] = {
    "yaml": (read_yaml, [SPEC]),
    "xml": (
        read_xml,
        [
            URDF,
            URDF.replace(b"<!-- <!DOCTYPE none> -->\n", b""),
            URDF.decode().replace("utf-8", "utf-16").encode("utf-16"),
        ],
    ),
    "trace": (read_trace, [TRACE]),
    "csv": (read_csv, [CSV]),
    "rosbag2": (read_metadata, [METADATA]),
    "sqlite": (read_sqlite, [sqlite_bag()]),
    "mcap": (
        read_recording,
        [
            mcap(sines(5), use_chunking=False, **BARE),
            mcap(sines(5), chunk_size=300, metadata={"role": "fit"}),
            mcap(sines(5), chunk_size=300, compression=CompressionType.ZSTD, enable_crcs=False),
            mcap(sines(5), compression=CompressionType.LZ4, enable_crcs=False),
            mcap(sines(5), encoding="json", use_chunking=False),
        ],
    ),
}


# Bytes with a special meaning in one of the formats.
SPECIAL_BYTES = [
    *(b"<!DOCTYPE", b"&a;", b"<<", b"*a", b"&a ", b"!!", b"[" * 40, b"- " * 40),
    *(b"\t", b"\r", b"nan", b"1e999", b",", b'"', b"'", b"{", b": ", b"---\n"),
    *(b"\xef\xbb\xbf", b"<?xml", b"]]>", b"<![CDATA[", b"\xc3", b"9" * 5000),
]


def error_of(reader: Callable[[Path], object], path: Path) -> TwinError | None:
    """The reader's TwinError or None; other exceptions are not caught."""
    try:
        reader(path)
    except TwinError as error:
        return error
    return None


@st.composite
def mutated(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """A valid file with some bytes changed, removed, repeated or replaced by special ones."""
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 5))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        kind = draw(st.integers(0, 5))
        if kind == 0 and data:
            data[at] = draw(st.integers(0, 255))
        elif kind == 1:
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == 2:
            data[at:at] = data[at : at + draw(st.integers(1, 200))]
        elif kind == 3:
            data[at : at + 8] = draw(
                st.sampled_from(
                    [b"\xff" * 8, b"\0" * 8, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80"]
                )
            )
        elif kind == 4:
            data[at:at] = draw(st.sampled_from(SPECIAL_BYTES))
        else:
            data = data[:at]
    return bytes(data)


@pytest.mark.parametrize("name", list(READERS))
def test_the_unmodified_seed_files_are_read(name: str, tmp_path: Path) -> None:
    reader, seeds = READERS[name]
    for seed in seeds:
        path = tmp_path / "seed"
        path.write_bytes(seed)
        if name == "yaml":
            assert yaml.load(path).data["kind"] == "fk"
        else:
            assert reader(path) is not None or name == "xml"


@pytest.mark.parametrize("name", list(READERS))
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_modified_files_raise_only_typed_printable_errors(
    name: str, data: st.DataObject, tmp_path: Path
) -> None:
    reader, seeds = READERS[name]
    path = tmp_path / "mutated"
    path.write_bytes(data.draw(mutated(seeds)))
    error = error_of(reader, path)
    assert error is None or (str(error).isprintable() and error.path == path)


@pytest.mark.parametrize("name", list(READERS))
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(content=st.binary(max_size=200))
@example(content=b"")
def test_random_bytes_raise_only_typed_printable_errors(
    name: str, content: bytes, tmp_path: Path
) -> None:
    reader, _ = READERS[name]
    path = tmp_path / "random"
    path.write_bytes(content)
    error = error_of(reader, path)
    assert error is None or (str(error).isprintable() and error.path == path)
