"""Digest of everything that can be read from an HDF5 file, except its stamp.

Objects are numbered in the order in which they are reached from the root: through links sorted by
name, then through object references. Each contributes its links, its attributes and, for a data
set, its type, shape and values. Parts are hashed as bytes with their lengths, never as text that
a library prints. A file cannot state more values than its size allows, so that a few bytes cannot
occupy the machine for hours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import count, product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5r, h5s, h5t

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits

_BLOCK_BYTES = 64 * 2**20
"""Size of the values that are read at once."""
_INTEGERS = (h5t.INTEGER, h5t.BITFIELD)
_NESTED = (h5t.ARRAY, h5t.VLEN, h5t.ENUM)


def content_digest(file: Any, path: Path, size: int, without: frozenset[str]) -> str:
    """Return the SHA-256 of the file's content, hex.

    Args:
        file: open ``h5py.File``.
        path: its path, for errors.
        size: its size, bytes.
        without: attributes of the root that are not part of the content.

    Raises:
        FormatError: content outside the file, or of a kind that cannot be hashed.
        LimitError: more values than the size of the file allows.
    """
    return _Content(file, path, size).digest({name.encode() for name in without})


class _Content:
    def __init__(self, file: Any, path: Path, size: int) -> None:
        self.path = path
        self.root = h5o.open(file.id, b"/")
        self.hashed = hashlib.sha256()
        most = limits.STAMPS.hdf5_expansion * size + limits.STAMPS.hdf5_least_bytes
        self.most_bytes = min(limits.STAMPS.hdf5_bytes, most)
        self.left_bytes = self.most_bytes
        # A variable-length element is at most as long as the file.
        self.most_elements = max(1, _BLOCK_BYTES // max(size, 1))
        self.numbers: dict[tuple[int, int], int] = {}
        self.objects: list[Any] = []
        self.where = "/"

    def digest(self, without: set[bytes]) -> str:
        self._number(self.root)
        for number in count():
            if number == len(self.objects):
                return self.hashed.hexdigest()
            item = self.objects[number]
            self.where = (h5py.h5i.get_name(item) or b"an object without a name").decode(
                "utf-8", "replace"
            )
            self._add(b"object")
            self._add_attributes(item, without if number == 0 else set())
            if isinstance(item, h5g.GroupID):
                self._add_links(item)
            elif isinstance(item, h5d.DatasetID):
                self._add_dataset(item)
            elif isinstance(item, h5t.TypeID):
                self._add_type(item)
            # An open object costs memory; its number is enough from here on.
            self.objects[number] = None
        raise AssertionError("unreachable")

    def _add(self, *parts: bytes | int) -> None:
        for part in parts:
            data = part if isinstance(part, bytes) else b"%d" % part
            self.hashed.update(b"%d:" % len(data))
            self.hashed.update(data)

    def _spend(self, size: int) -> None:
        self.left_bytes -= size
        if self.left_bytes < 0:
            raise LimitError(
                "states more values than a file of this size can contain",
                path=self.path,
                where=self.where,
                expected=f"at most {self.most_bytes} bytes of values; copy the rows in use to a "
                "new file",
            )

    def _refuse(self, problem: str, expected: str) -> FormatError:
        return FormatError(problem, path=self.path, where=self.where, expected=expected)

    def _number(self, item: Any) -> int:
        """Number of an object; it is hashed later if it was not reached before."""
        info = h5o.get_info(item)
        key = (int(info.fileno), int(info.addr))
        if key not in self.numbers:
            self.numbers[key] = len(self.numbers)
            self.objects.append(item)
        return self.numbers[key]

    def _add_links(self, group: Any) -> None:
        names = sorted(group)
        self._add(b"links", len(names))
        for name in names:
            kind = group.links.get_info(name).type
            if kind == h5l.TYPE_HARD:
                self._add(b"hard", name, self._number(h5o.open(group, name)))
            elif kind == h5l.TYPE_SOFT:
                self._add(b"soft", name, group.links.get_val(name))
            else:
                self.where = f"{self.where.rstrip('/')}/{name.decode('utf-8', 'replace')}"
                raise self._refuse(
                    "a link to another file", "links within this file; copy the target into it"
                )

    def _add_attributes(self, item: Any, without: set[bytes]) -> None:
        names: list[bytes] = []
        h5a.iterate(item, names.append)
        names = sorted(set(names) - without)
        self._add(b"attributes", len(names))
        for name in names:
            attribute = h5a.open(item, name)
            space, kind = attribute.get_space(), attribute.get_type()
            self._add(name)
            self._add_type(kind)
            shape = self._add_space(space)
            if shape is None:
                continue
            self._bound(shape, kind.get_size())
            array = np.empty(shape, self._memory_type(attribute, kind))
            if array.size:
                attribute.read(array, None if self._is_indirect(kind) else kind)
            self._add_values(array)

    def _add_dataset(self, data: Any) -> None:
        plist, kind = data.get_create_plist(), data.get_type()
        if plist.get_layout() == h5d.VIRTUAL or plist.get_external_count():
            raise self._refuse(
                "values stored in another file", "data sets whose values are stored in this file"
            )
        self._add_type(kind)
        shape = self._add_space(data.get_space())
        if shape is None:
            return
        self._bound(shape, kind.get_size())
        indirect = self._is_indirect(kind)
        memory = self._memory_type(data, kind)
        for start, counts in self._blocks(shape, kind.get_size(), indirect):
            array = np.empty(counts, memory)
            source = data.get_space()
            if shape:
                source.select_hyperslab(start, counts)
            target = h5s.create_simple(counts) if shape else h5s.create(h5s.SCALAR)
            data.read(target, source, array, None if indirect else kind)
            self._add_values(array)

    def _bound(self, shape: tuple[int, ...], item_bytes: int) -> None:
        """Refuse more rows and bytes than the size of the file allows, also rows without values."""
        rows = 1
        for length in shape:
            rows *= max(length, 1)
        self._spend(rows * item_bytes)

    def _blocks(
        self, shape: tuple[int, ...], item_bytes: int, indirect: bool
    ) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Start and counts of blocks whose values follow one another in the order of rows."""
        if 0 in shape:
            return
        most = self.most_elements if indirect else max(1, _BLOCK_BYTES // item_bytes)
        axis, inner = len(shape), 1
        while axis > 0 and inner * shape[axis - 1] <= most:
            axis -= 1
            inner *= shape[axis]
        if axis == 0:
            yield (0,) * len(shape), shape
            return
        rows = max(1, most // inner)
        for outer in product(*map(range, shape[: axis - 1])):
            for begin in range(0, shape[axis - 1], rows):
                counts = min(rows, shape[axis - 1] - begin)
                yield (
                    (*outer, begin, *(0,) * (len(shape) - axis)),
                    (*(1,) * len(outer), counts, *shape[axis:]),
                )

    def _add_space(self, space: Any) -> tuple[int, ...] | None:
        """Shape of a data space; None if it has no values."""
        if space.get_simple_extent_type() == h5s.NULL:
            self._add(b"null")
            return None
        shape = tuple(int(length) for length in space.shape)
        self._add(b"shape", len(shape), *shape)
        return shape

    def _memory_type(self, owner: Any, kind: Any) -> np.dtype[Any]:
        """Type of the values in memory: the stored bytes, or objects for what they refer to."""
        return owner.dtype if self._is_indirect(kind) else np.dtype(f"V{kind.get_size()}")

    def _is_indirect(self, kind: Any) -> bool:
        """Whether values are stored elsewhere: text and arrays of variable length, references."""
        code = kind.get_class()
        if code == h5t.COMPOUND:
            return any(
                self._is_indirect(kind.get_member_type(i)) for i in range(kind.get_nmembers())
            )
        if code in (h5t.VLEN, h5t.REFERENCE):
            return True
        if code == h5t.STRING:
            return bool(kind.is_variable_str())
        return code == h5t.ARRAY and self._is_indirect(kind.get_super())

    def _add_values(self, array: Any) -> None:
        if array.dtype.names:
            for name in array.dtype.names:
                self._add_values(array[name])
        elif not array.dtype.hasobject:
            self.hashed.update(np.ascontiguousarray(array).tobytes())
        elif h5t.check_ref_dtype(array.dtype) is not None:
            for reference in array.flat:
                self._add(self._referenced(reference))
        else:
            for value in array.flat:
                self._add_element(value)

    def _add_element(self, value: Any) -> None:
        """Add text or an array of variable length."""
        if isinstance(value, str):
            value = value.encode("utf-8", "surrogateescape")
        if isinstance(value, bytes):
            self._spend(len(value))
            self._add(value)
            return
        elements = np.asarray(value)
        self._spend(elements.nbytes)
        self._add(elements.size)
        self._add_values(elements)

    def _referenced(self, reference: Any) -> int:
        """Number of the object that a reference points at; -1 for an empty reference."""
        if isinstance(reference, h5r.RegionReference):
            raise self._refuse(
                "a reference to a region of a data set", "references to whole objects"
            )
        if not reference:
            return -1
        return self._number(h5r.dereference(reference, self.root))

    def _add_type(self, kind: Any) -> None:
        code = kind.get_class()
        self._add(b"type", code, kind.get_size())
        if code in _INTEGERS:
            self._add(kind.get_order(), kind.get_precision(), kind.get_offset())
            if code == h5t.INTEGER:
                self._add(kind.get_sign())
        elif code == h5t.FLOAT:
            self._add(kind.get_order(), kind.get_precision(), kind.get_offset())
            self._add(*kind.get_fields(), kind.get_ebias(), kind.get_norm())
        elif code == h5t.STRING:
            self._add(kind.get_cset(), kind.get_strpad(), int(kind.is_variable_str()))
        elif code == h5t.OPAQUE:
            self._add(kind.get_tag())
        elif code == h5t.COMPOUND:
            self._add(kind.get_nmembers())
            for i in range(kind.get_nmembers()):
                self._add(kind.get_member_name(i), kind.get_member_offset(i))
                self._add_type(kind.get_member_type(i))
        elif code in _NESTED:
            if code == h5t.ARRAY:
                self._add(*kind.get_array_dims())
            if code == h5t.ENUM:
                for i in range(kind.get_nmembers()):
                    self._add(kind.get_member_name(i), kind.get_member_value(i))
            self._add_type(kind.get_super())
        elif code == h5t.REFERENCE:
            self._add(int(kind.equal(h5t.STD_REF_OBJ)))
        else:
            raise self._refuse("values of a type that cannot be hashed", "numbers, text, records")
