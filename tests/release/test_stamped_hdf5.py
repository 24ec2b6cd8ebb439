"""The stamp of an HDF5 file covers everything that can be read from it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats.stamps.hdf5 import Hdf5Stamp

h5py = pytest.importorskip("h5py")

COLOURS = {"red": 0, "green": 1}
POINT = np.dtype({"names": ["x", "n"], "formats": ["f8", "i1"], "offsets": [0, 8], "itemsize": 16})
LONG = 2500


def write_rich(path: Path) -> Path:
    """A file with every kind of content that robot demonstrations use, and with others."""
    with h5py.File(path, "w") as file:
        file.attrs["env_args"] = '{"env": "Lift", "version": 1}'
        demo = file.create_group("data/demo_0")
        demo.attrs["model_file"] = "<mujoco/>"
        demo.attrs["offsets"] = np.arange(3.0)
        demo["actions"] = np.arange(40.0).reshape(20, 2)
        demo.create_dataset("images", data=np.zeros((50, 8, 8), np.uint8), compression="gzip")
        texts = demo.create_dataset("texts", (LONG,), h5py.string_dtype())
        texts[:] = [f"step {i}" for i in range(LONG)]
        ragged = demo.create_dataset("ragged", (2,), h5py.vlen_dtype(np.float64))
        ragged[0], ragged[1] = np.linspace(0, 1, LONG), np.array([1 / 3])
        demo["points"] = np.zeros(4, POINT)
        demo["colour"] = np.zeros(3, h5py.enum_dtype(COLOURS, "i1"))
        demo["done"] = np.array([True, False])
        demo["empty"] = h5py.Empty("f4")
        demo["scalar"] = 5
        file["best"] = h5py.SoftLink("/data/demo_0")
        file["again"] = demo
        reference = demo.create_dataset("of", (2,), h5py.ref_dtype)
        reference[0] = demo["actions"].ref
        file["kind"] = np.dtype("f4")
        file["spare"] = np.zeros(2)
    return path


def edited(path: Path, edit: Callable[[Any], object]) -> str:
    other = path.with_name("other.h5")
    shutil.copy(path, other)
    with h5py.File(other, "r+") as file:
        edit(file)
    return Hdf5Stamp(other).digest()


def replace_link(name: str, target: Any) -> Callable[[Any], None]:
    def edit(file: Any) -> None:
        if name in file:
            del file[name]
        file[name] = target(file) if callable(target) else target

    return edit


def set_value(name: str, at: Any, value: Any) -> Callable[[Any], None]:
    def edit(file: Any) -> None:
        file[name][at] = value

    return edit


def with_last_digit(file: Any) -> None:
    """Change the last bit of one number in a long array of variable length."""
    values = np.linspace(0, 1, LONG)
    values[LONG // 2] = np.nextafter(values[LONG // 2], 2.0)
    file["data/demo_0/ragged"][0] = values


CHANGES = {
    "attribute of the root": lambda f: f.attrs.modify("env_args", '{"env": "Lift", "version": 2}'),
    "attribute of a group": lambda f: f["data/demo_0"].attrs.modify("model_file", "<mujoco />"),
    "new attribute": lambda f: f["data/demo_0/actions"].attrs.create("unit", "rad"),
    "attribute that looks like the stamp's": lambda f: f.attrs.create("twin_7", "x"),
    "attribute of a number type": lambda f: f["data/demo_0"].attrs.create(
        "offsets", np.arange(3.0), dtype="f4"
    ),
    "value": set_value("data/demo_0/actions", (3, 1), 7.5),
    "value of a compressed image": set_value("data/demo_0/images", (49, 7, 7), 1),
    "a late element of text": set_value("data/demo_0/texts", LONG - 1, "step x"),
    "the last bit of a ragged array": with_last_digit,
    "member of a record": set_value("data/demo_0/points", 2, (0.0, 1)),
    "soft link retargeted": replace_link("best", h5py.SoftLink("/data")),
    "hard link retargeted": replace_link("again", lambda f: f["spare"]),
    "link added": lambda f: f.__setitem__("more", h5py.SoftLink("/nowhere")),
    "link removed": lambda f: f.__delitem__("again"),
    "reference retargeted": lambda f: f["data/demo_0/of"].__setitem__(0, f["spare"].ref),
    "reference filled": lambda f: f["data/demo_0/of"].__setitem__(1, f["spare"].ref),
    "names of an enum": replace_link(
        "data/demo_0/colour",
        lambda f: f.create_dataset(
            "c", data=np.zeros(3, h5py.enum_dtype({"red": 1, "green": 0}, "i1"))
        ),
    ),
    "shape": replace_link(
        "data/demo_0/actions",
        lambda f: f.create_dataset("a", data=np.arange(40.0).reshape(40, 1)),
    ),
    "named type": replace_link("kind", np.dtype("f8")),
}


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_that_can_be_read_changes_the_digest(name: str, tmp_path: Path) -> None:
    path = write_rich(tmp_path / "demo.h5")
    before = Hdf5Stamp(path).digest()
    assert edited(path, lambda file: None) == before
    assert edited(path, CHANGES[name]) != before


def test_a_stamp_changes_neither_the_digest_nor_the_content(tmp_path: Path) -> None:
    carrier = Hdf5Stamp(write_rich(tmp_path / "demo.h5"))
    before = carrier.digest()
    carrier.write("x" * 100_000)
    assert carrier.read() == "x" * 100_000
    assert carrier.digest() == before


def test_the_same_values_in_other_blocks_have_the_same_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pytest_twin.formats.stamps import hdf5_content

    path = write_rich(tmp_path / "demo.h5")
    before = Hdf5Stamp(path).digest()
    for size in (1, 24, 1000, 10_000):
        monkeypatch.setattr(hdf5_content, "_BLOCK_BYTES", size)
        assert Hdf5Stamp(path).digest() == before


def write_dataset(path: Path, shape: tuple[int, ...], **more: Any) -> Path:
    with h5py.File(path, "w") as file:
        file.create_dataset("x", shape, **more)
    return path


@pytest.mark.parametrize(
    ("shape", "more"),
    [
        ((60_000_000_000,), {"dtype": "u1", "chunks": (2**20,), "compression": "gzip"}),
        ((1, 6_000_000_000), {"dtype": "u1", "chunks": (1, 2**20)}),
        ((2**40, 0), {"dtype": "f8"}),
        ((2**30,), {"dtype": h5py.string_dtype(), "chunks": (2**10,)}),
    ],
    ids=["long", "one row", "rows of nothing", "texts"],
)
def test_a_small_file_with_billions_of_values_is_refused_at_once(
    shape: tuple[int, ...], more: dict[str, Any], tmp_path: Path
) -> None:
    path = write_dataset(tmp_path / "bomb.h5", shape, **more)
    assert path.stat().st_size < 10_000
    with pytest.raises(LimitError, match=r"bomb\.h5: /x: states more values than a file"):
        Hdf5Stamp(path).digest()


def test_one_stored_text_that_many_elements_share_is_counted_for_each(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "shared.h5", (20_000,), dtype=h5py.string_dtype())
    with h5py.File(path, "r+") as file:
        file["x"][0] = "y" * 60_000
        # All elements refer to the one text, as a crafted file may state.
        offset = file["x"].id.get_offset()
    content = bytearray(path.read_bytes())
    content[offset : offset + 16 * 20_000] = content[offset : offset + 16] * 20_000
    path.write_bytes(content)
    with pytest.raises(LimitError, match="states more values"):
        Hdf5Stamp(path).digest()


def write_external_link(file: Any) -> None:
    file["other"] = h5py.ExternalLink("weights.h5", "/w")


def write_external_values(file: Any) -> None:
    file.create_dataset("w", (2,), "f8", external=[("weights.bin", 0, 16)])


def write_virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((2,), "f8")
    layout[:] = h5py.VirtualSource("weights.h5", "w", (2,))
    file.create_virtual_dataset("w", layout)


def write_region(file: Any) -> None:
    file["v"] = np.arange(5)
    file.create_dataset("r", (1,), h5py.regionref_dtype)[0] = file["v"].regionref[1:3]


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (write_external_link, "/other: a link to another file"),
        (write_external_values, "/w: values stored in another file"),
        (write_virtual, "/w: values stored in another file"),
        (write_region, "/r: a reference to a region of a data set"),
    ],
)
def test_content_that_the_stamp_cannot_cover_is_refused(
    write: Callable[[Any], None], words: str, tmp_path: Path
) -> None:
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        write(file)
    with pytest.raises(FormatError, match=words):
        Hdf5Stamp(tmp_path / "demo.h5").digest()


def test_groups_that_contain_each_other_end(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        inner = file.create_group("a/b")
        inner["up"] = file["a"]
    assert len(Hdf5Stamp(tmp_path / "demo.h5").digest()) == 64
