"""Intake: the files of a supplier are unpacked, stored unchanged and listed in a manifest."""

from __future__ import annotations

import io
import json
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from asset_robots import write_arm

from pytest_twin.asset import manifest
from pytest_twin.asset.evidence import kind_of, missing, sort_files
from pytest_twin.asset.unpack import IntakeLimits, unpack
from pytest_twin.cli import main
from pytest_twin.errors import FormatError, LimitError, PathError
from pytest_twin.formats.digest import file_sha256

pytestmark = pytest.mark.usefixtures("commands_in_process")

SMALL = IntakeLimits(files=4, file_bytes=2000, total_bytes=5000, depth=3, name_bytes=40)


def write_zip(path: Path, *entries: tuple[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return path


def write_tar(path: Path, *members: tarfile.TarInfo | tuple[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for member in members:
            if isinstance(member, tarfile.TarInfo):
                archive.addfile(member)
            else:
                info = tarfile.TarInfo(member[0])
                info.size = len(member[1])
                archive.addfile(info, io.BytesIO(member[1]))
    return path


def special_member(name: str, kind: bytes, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def write_zip_with_link(path: Path) -> Path:
    entry = zipfile.ZipInfo("link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    return path


def unpack_archive(path: Path, limits: IntakeLimits = SMALL) -> list[str]:
    folder = path.parent / f"{path.name}.out"
    folder.mkdir()
    return unpack(str(path), str(folder), limits)


@pytest.mark.parametrize("make", [write_zip, write_tar])
def test_files_are_stored_unchanged_and_read_only(
    tmp_path: Path, make: Callable[..., Path]
) -> None:
    origin = make(tmp_path / "asset", ("a/robot.urdf", b"<robot/>"), ("b.stl", b"\0" * 1500))
    assert unpack_archive(origin) == ["a/robot.urdf", "b.stl"]
    arrived = tmp_path / "asset.out/a/robot.urdf"
    assert arrived.read_bytes() == b"<robot/>"
    assert stat.S_IMODE(arrived.stat().st_mode) == 0o444


@pytest.mark.parametrize("make", [write_zip, write_tar])
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../out.txt", "a path outside the archive"),
        ("/etc/out.txt", "a path outside the archive"),
        ("a/../../out.txt", "a path outside the archive"),
        ("C:/out.txt", "a name of another system"),
        ("a/\x1b[2J.txt", "a name with a control character"),
    ],
)
def test_file_names_outside_the_archive_are_refused(
    tmp_path: Path, make: Callable[..., Path], name: str, words: str
) -> None:
    origin = make(tmp_path / "asset", (name, b"x"))
    with pytest.raises(PathError, match=words):
        unpack_archive(origin)
    assert not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize(
    "make",
    [
        write_zip_with_link,
        lambda path: write_tar(path, special_member("link", tarfile.SYMTYPE, "/etc/passwd")),
        lambda path: write_tar(path, special_member("hard", tarfile.LNKTYPE, "/etc/passwd")),
        lambda path: write_tar(path, special_member("pipe", tarfile.FIFOTYPE)),
        lambda path: write_tar(path, special_member("device", tarfile.CHRTYPE)),
    ],
)
def test_links_and_devices_in_archives_are_refused(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    with pytest.raises(PathError, match="a link or a device"):
        unpack_archive(make(tmp_path / "asset"))


@pytest.mark.parametrize("make", [write_zip, write_tar])
@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ([("a", b"\0" * 2001)], "a file is too large"),
        ([(f"{n}", b"\0" * 1900) for n in range(3)], "too large after unpacking"),
        ([(f"{n}", b"") for n in range(5)], "too many files"),
        ([("a/b/c/d", b"")], "folders too deep"),
        ([("n" * 41, b"")], "a name is too long"),
    ],
)
def test_archives_above_the_limits_are_refused(
    tmp_path: Path, make: Callable[..., Path], entries: list[tuple[str, bytes]], words: str
) -> None:
    with pytest.raises(LimitError, match=words):
        unpack_archive(make(tmp_path / "asset", *entries))


def test_two_names_that_differ_only_in_case_are_refused(tmp_path: Path) -> None:
    origin = write_zip(tmp_path / "asset", ("Robot.urdf", b"1"), ("robot.urdf", b"2"))
    with pytest.raises(FormatError, match="two files of one name"):
        unpack_archive(origin)


@pytest.mark.parametrize("cut", [30, 60, 200])
@pytest.mark.parametrize("make", [write_zip, write_tar])
def test_truncated_archives_are_refused(
    tmp_path: Path, make: Callable[..., Path], cut: int
) -> None:
    origin = make(tmp_path / "asset", ("a", bytes(range(256)) * 7), ("b", b"text" * 20))
    origin.write_bytes(origin.read_bytes()[:-cut])
    with pytest.raises(FormatError):
        unpack_archive(origin)


def test_other_files_and_empty_archives_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello" * 200)
    with pytest.raises(FormatError, match="not an archive"):
        unpack_archive(tmp_path / "text")
    with pytest.raises(FormatError, match="it contains no file"):
        unpack_archive(write_zip(tmp_path / "empty"))


def test_a_folder_with_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset/link").symlink_to("/etc/passwd")
    with pytest.raises(PathError, match="a link"):
        unpack_archive(tmp_path / "asset")


def test_files_of_version_control_are_left_out(tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    (clone / ".git/hooks").mkdir(parents=True)
    (clone / ".git/hooks/update").symlink_to("/etc/passwd")
    (clone / "part").mkdir()
    (clone / "part/.git").write_text("gitdir: ../.git/modules/part")
    (clone / "part/.gitignore").write_text("*.bak")
    (clone / "robot.urdf").write_text("<robot/>")
    assert unpack_archive(clone) == ["part/.gitignore", "robot.urdf"]
    packed = write_tar(tmp_path / "asset", ("a/.git/HEAD", b"ref"), ("a/robot.urdf", b"<robot/>"))
    assert unpack_archive(packed) == ["a/robot.urdf"]


KINDS = {
    "docs/manual.pdf": "manual",
    "docs/User_Guide.md": "manual",
    "sdk/Programming_Guide.pdf": "manual",
    "README.md": "note",
    "cad/arm.STEP": "CAD",
    "cal/Calibration-1234.pdf": "calibration certificate",
    "docs/naming_table.csv": "naming table",
    "Joint-Names.xlsx": "naming table",
    "nomenclature.pdf": "naming table",
    "firmware/v3.bin": "firmware",
    "firmware/update_3.10.zip": "firmware",
    "controller-FW-3.10.tar.gz": "firmware",
    "Firmware Release/version.txt": "firmware",
    "firmware/release_notes.txt": "note",
    "sdk/include/robot.h": "SDK",
    "arm_sdk-1.2/python/arm.py": "SDK",
    "ArmSDK.zip": "SDK",
    "robot_api.py": "SDK",
    "sdk/html/index.html": "SDK",
    "SDK/LICENSE": "licence",
    "sdk/urdf/arm.urdf": "model",
    "sdk/meshes/fw_link.stl": "mesh",
    "urdf/arm.urdf": "model",
    "meshes/arm.stl": "mesh",
    "odd": "other",
    "misc/rapid_capital.yaml": "configuration",
}


@pytest.mark.parametrize("name", KINDS)
def test_the_kind_of_a_file_is_taken_from_its_path(name: str) -> None:
    assert kind_of(name) == KINDS[name]


def test_the_vertices_beside_a_gltf_file_are_no_firmware() -> None:
    names = ["meshes/arm.gltf", "meshes/arm.bin", "arm.bin"]
    assert sort_files(names) == {
        "firmware": ["arm.bin"],
        "mesh": ["meshes/arm.bin", "meshes/arm.gltf"],
    }


def test_missing_kinds_are_listed() -> None:
    assert missing(["CAD", "manual"]) == [
        "calibration certificate",
        "naming table",
        "firmware",
        "SDK",
    ]


def test_files_that_pytest_twin_wrote_are_no_evidence_of_the_supplier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What audit, realize and init of an earlier day left in the folder that is taken in."""
    urdf = write_arm(tmp_path)
    package = urdf.parents[1]
    monkeypatch.chdir(package)
    assert main(["audit", str(urdf)]) in (0, 1)
    assert main(["realize", str(urdf), "--out", str(package / "realized")]) == 0
    (package / "golden").mkdir()
    modeline = "# yaml-language-server: $schema=../schemas/golden.schema.json\n"
    (package / "golden/fk.yaml").write_text(f"{modeline}schema: 1\nkind: fk\n")
    # Files of the supplier that resemble them by name.
    (package / "report.html").write_text("<html>tests of the arm</html>")
    (package / "calibration.json").write_text('{"schema": 1, "date": "2024-05-06"}')
    out = tmp_path / "taken"
    assert main(["intake", str(package), "--out", str(out)]) == 0
    source = json.loads((out / "manifest.json").read_text())["states"]["source"]
    own = {name.removeprefix("source/") for name in source["evidence"]["written by pytest-twin"]}
    written = (file for file in (package / "realized").rglob("*") if file.is_file())
    realized = {file.relative_to(package).as_posix() for file in written}
    audit = {".pytest-twin.json", "arm.urdf.audit.html", "arm.urdf.audit.json"}
    assert own == audit | {"golden/fk.yaml"} | realized
    assert source["evidence"]["manual"] == ["source/report.html"]
    assert source["evidence"]["calibration certificate"] == ["source/calibration.json"]
    assert source["evidence"]["model"] == ["source/urdf/arm.urdf"]


def test_intake_writes_a_manifest_and_refuses_to_run_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    package = write_arm(tmp_path).parents[1]
    (package / "manual.pdf").write_bytes(b"%PDF")
    out = tmp_path / "taken"
    words = [
        "intake",
        str(package),
        "--out",
        str(out),
        "--supplier",
        "Arms",
        "--date",
        "2024-05-06",
    ]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "missing: calibration certificate" in printed
    assert f"next: pytest-twin realize {out}/source/urdf/arm.urdf" in printed
    source = json.loads((out / "manifest.json").read_text())["states"]["source"]
    assert (source["supplier"], source["received"]) == ("Arms", "2024-05-06")
    wanted = ["CAD", "calibration certificate", "naming table", "firmware", "SDK"]
    assert source["missing"] == wanted
    assert source["evidence"]["manual"] == ["source/manual.pdf"]
    for name, digest in source["files"].items():
        assert file_sha256(out / name) == digest
    assert main(words) == 2
    assert "its source is never overwritten" in capsys.readouterr().err


def test_a_modified_manifest_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("a")
    state = manifest.state_of(tmp_path, [tmp_path / "a"])
    path = tmp_path / "manifest.json"
    manifest.write(path, manifest.Manifest("robot", {"source": state}))
    assert manifest.read(path).states["source"].digest == state.digest
    path.write_text(path.read_text().replace(state.files["a"], "0" * 64))
    with pytest.raises(FormatError, match="the digest does not follow from the files"):
        manifest.read(path)
    manifest.write(path, manifest.Manifest("robot", {"source": state}))
    path.write_text(path.read_text().replace('"robot"', '"tobor"'))
    with pytest.raises(FormatError, match="the manifest was changed"):
        manifest.read(path)
    path.write_text('{"schema": 1, "asset": "x", "states": {"source": {"files": {"../a": "0"}}}}')
    with pytest.raises(FormatError, match="not a state"):
        manifest.read(path)
