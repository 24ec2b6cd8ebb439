"""Archives of recorded tosses: reading, and protection against malicious files."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.tosses import read_tosses


def _toss(rows: int = 20) -> np.ndarray:
    table = np.zeros((rows, 19), dtype=np.float32)
    table[:, 2] = np.linspace(1.0, 0.5, rows)
    table[:, 3] = 1.0
    return table


def _zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_tosses_keep_their_names_order_and_columns(tmp_path: Path) -> None:
    path = tmp_path / "tosses.npz"
    np.savez(path, **{"7": _toss(), "2": _toss(30)})
    one, two = read_tosses(path)
    assert (one.name, two.name) == ("7", "2")
    assert two.position.shape == (30, 3)
    assert one.position[0, 2] == pytest.approx(1.0)
    assert not one.has_times


class _Boom:
    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path("pwned"),))


@pytest.mark.parametrize(
    ("member", "words"),
    [
        (pickle.dumps(_Boom()), "not an array of floating-point numbers"),
        (_npy(np.array([_Boom()], dtype=object)), "not an array of floating-point numbers"),
        (_npy(_toss())[:-8], "bytes"),
        (_npy(_toss()).replace(b"(20, 19)", b"(2**9,) "), "not an array of floating-point numbers"),
        (_npy(_toss()).replace(b"(20, 19)", b"(99999, "), "not an array of floating-point numbers"),
        (_npy(_toss()[:, :7]), "not a toss"),
        (_npy(_toss(3)), "not a toss"),
        (_npy(np.full((20, 19), np.nan)), "not finite"),
        (_npy(np.zeros((20, 19))), "not a unit quaternion"),
        (_npy(np.zeros((20, 19), dtype=complex)), "not an array of floating-point numbers"),
    ],
)
def test_an_invalid_archive_member_is_refused_and_never_unpickled(
    member: bytes, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FormatError, match=words):
        read_tosses(_zip(tmp_path / "bad.npz", {"0.npy": member}))
    assert not (tmp_path / "pwned").exists()


def test_a_wrong_stated_array_size_is_refused_before_allocation(tmp_path: Path) -> None:
    header = _npy(np.zeros((20, 19)))
    claimed = header.replace(b"(20, 19), }  ", b"(9999999,19)}")
    assert claimed != header
    with pytest.raises(FormatError, match="for 3040 bytes"):
        read_tosses(_zip(tmp_path / "claims.npz", {"0.npy": claimed}))


def test_an_archive_with_too_much_unpacked_data_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound = limits.TossLimits(unpacked_bytes=1000)
    monkeypatch.setattr("pytest_twin.formats.tosses.TOSSES", bound)
    with pytest.raises(LimitError, match="unpacked bytes"):
        read_tosses(_zip(tmp_path / "bomb.npz", {"0.npy": bytes(100_000)}))


@pytest.mark.parametrize("data", [b"", b"PK\3\4", b"\x93NUMPY", bytes(100)])
def test_a_file_that_is_not_an_archive_is_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"bad\.npz"):
        read_tosses(path)
