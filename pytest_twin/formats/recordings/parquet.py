"""Read columns of numbers from Parquet files with ``pyarrow``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import Roots, open_regular
from pytest_twin.formats.ros_serialization import Floats

_FIELD = re.compile(r"\{(episode_chunk|episode_index|chunk_index|file_index)(?::0?\d{1,2}d)?\}")


def data_files(folder: Path, template: object, at: Path) -> list[Path]:
    """Return the files that match a template such as ``data/chunk-{chunk_index:03d}/...``.

    Args:
        folder: folder of the data set; files outside it are refused.
        template: path template from the data set's metadata.
        at: file that contains the template, for errors.

    Raises:
        FormatError: no template, or no file matches it.
        PathError: a match is not a regular file, or is a link that leaves the folder.
        LimitError: too many files.
    """
    if not isinstance(template, str) or not template.endswith(".parquet"):
        raise FormatError(
            "does not state the path of the data",
            path=at,
            where="data_path",
            value=template,
            expected="such as data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        )
    pattern = "*".join(re.split(r"\*+", _FIELD.sub("*", template)))
    parts = Path(pattern).parts
    if Path(pattern).is_absolute() or ".." in parts or any(mark in pattern for mark in "{}[]?"):
        raise FormatError(
            "not a path inside the data set",
            path=at,
            where="data_path",
            value=template,
            expected="a path inside its folder, such as data/chunk-{chunk_index:03d}/"
            "file-{file_index:03d}.parquet",
        )
    found = sorted(folder.glob(pattern))
    require_at_most(len(found), limits.PARQUET.files_count, "too many data files", path=folder)
    if not found:
        raise FormatError(
            "no data file is there",
            path=at,
            where="data_path",
            value=template,
            expected=f"Parquet files at {pattern}; download the whole data set",
        )
    roots = Roots(folder)
    return [
        roots.resolve(str(file.relative_to(folder)), at=folder / "data", where="data_path")
        for file in found
    ]


def read_columns(files: Sequence[Path], columns: Mapping[str, int]) -> dict[str, Floats]:
    """Read columns of all files, concatenated.

    Args:
        files: files with the same columns.
        columns: name -> number of values in each row, 0 for a plain number.

    Returns:
        name -> (n,) or (n, values), float64.

    Raises:
        FormatError: ``pyarrow`` is missing, or a file is damaged or has other columns.
        LimitError: the content exceeds ``limits.PARQUET``.
        PathError: a path is not a regular file.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise FormatError(
            "Parquet files are read by pyarrow, which is not installed",
            path=files[0],
            expected="pip install 'pytest-twin[lerobot]'",
        ) from None
    parts: dict[str, list[Floats]] = {name: [] for name in columns}
    rows = 0
    for file in files:
        with open_regular(file) as stream:
            try:
                parquet = pyarrow.parquet.ParquetFile(stream)
                rows += parquet.metadata.num_rows
                _check_size(parquet.metadata, columns, rows, file)
                missing = set(columns) - set(parquet.schema_arrow.names)
                if missing:
                    raise FormatError(
                        "a column is missing",
                        path=file,
                        value=", ".join(sorted(missing)),
                        expected=", ".join(columns),
                    )
                table = parquet.read(columns=list(columns), use_threads=False)
                for name, width in columns.items():
                    parts[name].append(_numbers(table.column(name), width, name, file))
            except _damage(pyarrow.ArrowException) as error:
                reason = " ".join(str(error).split())[:120] or "out of memory"
                raise FormatError(f"cannot be read as Parquet: {reason}", path=file) from None
    return {name: np.concatenate(some) for name, some in parts.items()}


def _damage(arrow: type[Exception]) -> tuple[type[Exception], ...]:
    """Return the exceptions that pyarrow raises on damaged files, its own and Python's."""
    return (arrow, OSError, MemoryError, OverflowError, ValueError, KeyError, IndexError, TypeError)


def _check_size(metadata: Any, columns: Mapping[str, int], rows: int, file: Path) -> None:
    values = sum(max(1, width) for width in columns.values())
    require_at_most(rows * values, limits.MCAP.samples_count, "too many values", path=file)
    # Check whole row groups: pyarrow crashes the process if it is asked for the size of a column
    # with damaged statistics.
    unpacked = sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups))
    if not 0 <= unpacked <= limits.PARQUET.uncompressed_bytes:
        raise LimitError(
            "too large after decompression",
            path=file,
            value=unpacked,
            unit="bytes",
            expected=f"at most {limits.PARQUET.uncompressed_bytes} bytes",
        )


def _numbers(column: Any, width: int, name: str, file: Path) -> Floats:
    import pyarrow

    def refuse(problem: str) -> FormatError:
        expected = f"{width} numbers in each row" if width else "one number in each row"
        return FormatError(problem, path=file, where=name, expected=expected)

    whole = column.combine_chunks()
    if isinstance(whole, pyarrow.ChunkedArray):
        whole = pyarrow.concat_arrays(whole.chunks) if whole.num_chunks else pyarrow.array([])
    count = len(column)
    kind = whole.type
    nested = pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind)
    nested = nested or pyarrow.types.is_large_list(kind)
    if nested != bool(width) and not (nested and width == 0) and not (width == 1 and not nested):
        raise refuse(f"a column of {kind}")
    if nested:
        lengths = whole.value_lengths() if not whole.null_count else None
        per_row = max(1, width)
        if lengths is None or (count and not (np.asarray(lengths) == per_row).all()):
            raise refuse("rows of different lengths")
        whole = whole.flatten()
    if not (pyarrow.types.is_floating(whole.type) or pyarrow.types.is_integer(whole.type)):
        raise refuse(f"a column of {whole.type}")
    values = np.asarray(whole.to_numpy(zero_copy_only=False), dtype=np.float64)
    return values.reshape(count, width) if width else values.reshape(count)
