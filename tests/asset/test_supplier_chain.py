"""From the supplier's archive to the release: one changed byte at each step is seen and named."""

from __future__ import annotations

import base64
import json
import re
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from asset_robots import write_arm
from in_process import InProcess

from pytest_twin.asset import manifest
from pytest_twin.cli import main
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.gate import runner as gate_runner
from pytest_twin.gate import worker
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.run_end import Policy, RunResult, finish
from pytest_twin.gate.verdict import SessionFacts

pytestmark = pytest.mark.usefixtures("commands_in_process")

ASSET = Path("asset/arm")
URDF = ASSET / "source/arm_description/urdf/arm.urdf"
NO_RELEASE = "no release:"
HOLDS = "release 0001 still holds"


@dataclass(frozen=True)
class Walk:
    """What a user has after the commands of the how-to: an intake, a twin, stamped data."""

    archive: Path
    intake: Path
    twin: Path
    data: Path


def new_gate(twin: Path) -> Gate:
    """The gate of a twin, which reads its model as a new child process would."""
    worker._realization.cache_clear()
    worker._twin.cache_clear()
    return Gate(twin / "twin.yaml", gate_runner.Runner())


def run_gate(twin: Path, *, sign: bool = True) -> RunResult:
    """Run the stale goldens of a twin, as ``pytest --twin-release`` does."""
    gate = new_gate(twin)
    for task in gate.plan().stale:
        gate.outcomes[task.key] = gate.run_golden(
            task.golden, task.realization, reasons=task.reasons, progress=None
        )
    return finish(gate, SessionFacts(), Policy(sign=sign))


def pack(folder: Path, archive: Path) -> Path:
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as written:
            for file in sorted(folder.rglob("*")):
                written.write(file, file.relative_to(folder))
    else:
        with tarfile.open(archive, "w:gz") as written:
            written.add(folder, arcname=".")
    return archive


def supply(tmp_path: Path) -> Path:
    """A supplier's folder: a ROS package, documents, and code that the twin must never run."""
    folder = tmp_path / "supplied"
    write_arm(folder)
    for name, text in {
        "docs/naming_table.csv": "model,controller\nlift,J1\n",
        "sdk/conftest.py": "raise SystemExit('code of the supplier ran')\n",
        "sdk/golden/home.yaml": "no: spec\n",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def keep_goldens(twin: Path, *kinds: str) -> None:
    """Remove the other goldens: each test runs only what its change makes stale."""
    for folder in (twin / "golden").iterdir():
        if folder.name not in kinds:
            shutil.rmtree(folder)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    tmp_path = tmp_path_factory.mktemp("walk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gate_runner, "Sandbox", InProcess)
        for name in ("CONFIG", "STATE"):
            patch.setenv(f"XDG_{name}_HOME", str(tmp_path / "user"))
        archive = pack(supply(tmp_path), tmp_path / "supplier.zip")
        intake, twin = tmp_path / "arm", tmp_path / "arm_twin"
        assert main(["intake", str(archive), "--out", str(intake), "--supplier", "Arms"]) == 0
        urdf = intake / "source/arm_description/urdf/arm.urdf"
        assert main(["realize", str(urdf), "--out", str(intake)]) == 0
        assert main(["init", str(intake / "arm.xml"), "--out", str(twin)]) == 0
        keep_goldens(twin, "fk", "mass_properties")
        first = run_gate(twin).lines
        assert first[-1].startswith("release 0001 signed"), first
        data = tmp_path / "wave.mcap"
        write_wave(data)
        assert main(["stamp", str(data), "--release", str(twin)]) == 0
        yield Walk(archive, intake, twin, data)


def write_wave(path: Path) -> None:
    time = np.arange(0.0, 1.0, 0.01)
    stamps = np.rint(1e9 * time).astype(np.int64) + 10**18
    wave = 0.2 * np.sin(3 * time)[:, None]
    series = JointSeries("/joint_states", ("lift",), stamps, stamps, wave, None, None)
    write_recording(path, [series], {})


@pytest.fixture
def restored(walk: Walk) -> Iterator[Walk]:
    """The walk, whose files are as before after the test."""
    roots = (walk.intake, walk.twin)
    before = {
        file: file.read_bytes() for root in roots for file in root.rglob("*") if file.is_file()
    }
    yield walk
    for release in walk.twin.glob("releases/000[2-9]"):
        shutil.rmtree(release)
    for root in roots:
        for file in root.rglob("*"):
            if file.is_file() and file not in before and ".twin" not in file.parts:
                file.unlink()
    for file, content in before.items():
        file.parent.mkdir(exist_ok=True, parents=True)
        if not file.is_file() or file.read_bytes() != content:
            write(file, content)


def write(file: Path, content: bytes) -> None:
    if file.exists():
        file.chmod(0o644)
    file.write_bytes(content)


def edit(file: Path, old: bytes, new: bytes) -> None:
    """Change one byte."""
    content = file.read_bytes()
    assert old in content
    assert len(old) == len(new)
    write(file, content.replace(old, new, 1))


@dataclass(frozen=True)
class Step:
    """One changed byte: in which file, and the words that name step and file."""

    file: Path
    old: bytes
    new: bytes
    step: str
    named: str


STEPS = {
    "source URDF": Step(
        URDF, b'value="2"', b'value="3"', "the source asset has changed since intake",
        "source/arm_description/urdf/arm.urdf was changed",
    ),
    "source document": Step(
        ASSET / "source/docs/naming_table.csv", b"J1", b"J2",
        "the source asset has changed since intake", "source/docs/naming_table.csv was changed",
    ),
    "manifest": Step(
        ASSET / "manifest.json", b'"Arms"', b'"Arma"', "the manifest was changed",
        "asset/arm/manifest.json",
    ),
    "digest in the manifest": Step(
        ASSET / "manifest.json", b'"digest": "', b'"digesT": "',
        "the digest does not follow from the files", "asset/arm/manifest.json",
    ),
    "normalized URDF": Step(
        ASSET / "arm.urdf", b"0.4", b"0.5", "the normalized asset has changed since",
        "arm.urdf was changed",
    ),
    "mesh": Step(
        ASSET / "meshes/part.obj", b"0.2", b"0.3", "the normalized asset has changed since",
        "meshes/part.obj was changed",
    ),
    "realized MJCF": Step(
        ASSET / "arm.xml", b'mass="1.5"', b'mass="1.6"', "the realization asset has changed since",
        "arm.xml was changed",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STEPS)
def test_one_changed_byte_blocks_the_release_and_step_and_file_are_named(
    restored: Walk, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    step = STEPS[name]
    edit(restored.twin / step.file, step.old, step.new)
    result = run_gate(restored.twin)
    assert result.is_blocked
    lines = result.lines[result.lines.index(NO_RELEASE) :]
    assert any(step.step in line and step.named in line for line in lines), lines
    unsigned = run_gate(restored.twin, sign=False).lines
    assert any(line.startswith("blocks a release: ") and step.named in line for line in unsigned)
    capsys.readouterr()
    main(["fresh", str(restored.data), "--twin", str(restored.twin)])
    printed = capsys.readouterr().out
    assert step.step in printed
    assert step.named in printed


def test_a_changed_value_in_twin_yaml_makes_goldens_stale_and_is_named(restored: Walk) -> None:
    file = restored.twin / "twin.yaml"
    file.write_text(
        file.read_text() + "fit: {id: weighed, body: {upper: {mass: 1.7}}}\n", encoding="utf-8"
    )
    plan = new_gate(restored.twin).plan()
    (mass,) = (task for task in plan.stale if task.golden.kind == "mass_properties")
    assert "mujoco/inertia:upper: mass 1.5 -> 1.7 kg" in map(str, mass.reasons)
    assert HOLDS not in run_gate(restored.twin).lines


@pytest.mark.parametrize("name", ["arm.urdf", "arm.xml"])
def test_a_comment_and_white_space_in_a_generated_file_change_nothing(
    restored: Walk, name: str
) -> None:
    file = restored.twin / ASSET / name
    text = file.read_text()
    head, _, tail = text.partition("\n")
    write(file, f"{head}\n<!-- reviewed -->\n\n{tail}".replace("  <", "    <").encode())
    assert run_gate(restored.twin).lines[-1] == HOLDS


def test_an_unchanged_chain_holds(walk: Walk, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_gate(walk.twin).lines[-1] == HOLDS
    assert main(["fresh", str(walk.data), "--twin", str(walk.twin)]) == 0
    assert "nothing has changed in the twin since" in capsys.readouterr().out


def test_a_change_in_the_intake_that_the_twin_was_copied_from_is_named(restored: Walk) -> None:
    name = "source/arm_description/urdf/arm.urdf"
    edit(restored.intake / name, b'value="2"', b'value="3"')
    result = run_gate(restored.twin)
    assert result.is_blocked
    (line,) = (line for line in result.lines if f"{name} was changed" in line)
    assert line.strip().startswith(str(restored.intake / "manifest.json"))


def test_a_model_that_is_no_file_of_the_asset_is_noted(restored: Walk) -> None:
    shutil.copy(restored.twin / ASSET / "arm.xml", restored.twin / ASSET / "mine.xml")
    file = restored.twin / "twin.yaml"
    file.write_text(file.read_text().replace("asset/arm/arm.xml", "asset/arm/mine.xml"))
    lines = run_gate(restored.twin).lines
    assert any("no model of this twin is among its files" in line for line in lines)
    assert any("models mujoco arm.xml -> none" in line for line in lines)
    assert signed(lines)


def test_a_manifest_that_is_gone_blocks_the_release(restored: Walk) -> None:
    (restored.twin / ASSET / "manifest.json").unlink()
    result = run_gate(restored.twin)
    assert result.is_blocked
    assert any("manifest.json: no manifest lists the files of" in line for line in result.lines)


def test_an_edit_is_released_once_its_reason_and_owner_are_stated(restored: Walk) -> None:
    edit(restored.twin / ASSET / "arm.urdf", b"0.4", b"0.5")
    file = restored.twin / "twin.yaml"
    stated = "edited: {asset/arm/arm.urdf: {reason: friction measured, owner: A. Engineer}}\n"
    file.write_text(file.read_text() + stated)
    lines = run_gate(restored.twin).lines
    assert any("the stated edits of generated files" in line for line in lines)
    payload = json.loads(released_statement(restored.twin, signed(lines)))
    edits = payload["predicate"]["ids"]["chain"]["asset/arm/manifest.json"]["edited"]
    assert edits["arm.urdf"]["owner"] == "A. Engineer"
    # A later edit of the same file is another release.
    edit(restored.twin / ASSET / "arm.urdf", b"0.5", b"0.6")
    assert signed(run_gate(restored.twin).lines)
    file.write_text(file.read_text().replace("arm/arm.urdf", "arm/arm.xml"))
    result = run_gate(restored.twin)
    assert any("edited.asset/arm/arm.xml: the file is as" in line for line in result.lines)


def signed(lines: Sequence[str]) -> int:
    """The number of the release that a run signed, 0 if it signed none."""
    match = re.match(r"release (\d+) signed", lines[-1])
    return int(match[1]) if match else 0


def released_statement(twin: Path, number: int) -> bytes:
    envelope = json.loads((twin / f"releases/{number:04d}/release.dsse.json").read_bytes())
    return base64.b64decode(envelope["payload"])


def test_the_release_states_every_step_with_its_digests_and_commands(walk: Walk) -> None:
    predicate = json.loads(released_statement(walk.twin, 1))["predicate"]
    ((name, chain),) = predicate["ids"]["chain"].items()
    assert name == "asset/arm/manifest.json"
    source, normalized, realization = (chain["states"][state] for state in manifest.STATES)
    assert source["origin"] == {"name": "supplier.zip", "sha256": file_sha256(walk.archive)}
    assert source["made"]["command"][:3] == ["pytest-twin", "intake", "supplier.zip"]
    assert normalized["made"]["command"][:2] == ["pytest-twin", "realize"]
    assert normalized["made"]["from"]["digest"] == source["digest"]
    read = normalized["made"]["from"]["files"]
    urdf = "source/arm_description/urdf/arm.urdf"
    assert read[urdf] == file_sha256(walk.twin / ASSET / urdf)
    assert realization["made"]["from"]["digest"] == normalized["digest"]
    assert realization["files"]["arm.xml"] == file_sha256(walk.twin / ASSET / "arm.xml")
    assert {"pytest-twin", "mujoco"} <= set(realization["made"]["versions"])
    assert chain["models"] == {"mujoco": "arm.xml"}


def test_source_in_twin_yaml_lists_the_files_of_the_supplier_only(walk: Walk) -> None:
    stated = yaml.safe_load((walk.twin / "twin.yaml").read_text())
    assert stated["model"] == "asset/arm/arm.xml"
    assert URDF.as_posix() in stated["source"]
    assert all(name.startswith("asset/arm/source/") for name in stated["source"])


@pytest.mark.parametrize(
    ("name", "step"),
    [
        (URDF, "source"),
        (ASSET / "arm.urdf", "normalized"),
        (ASSET / "meshes/part.obj", "normalized"),
        (ASSET / "arm.xml", "realization"),
        (ASSET / "manifest.json", "manifest"),
    ],
)
def test_verify_names_the_step_of_a_changed_file_in_the_release(
    restored: Walk, name: Path, step: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = restored.twin / "releases/0001/files" / name
    write(file, file.read_bytes()[:-1] + b"#")
    capsys.readouterr()
    assert main(["verify", str(restored.twin)]) == 1
    printed = capsys.readouterr().out
    assert re.search(
        rf"files/{re.escape(name.as_posix())}: changed.*\({step} of the asset", printed
    )


def test_no_spec_and_no_code_of_the_supplier_is_collected(
    walk: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(walk.twin)
    collected = Collected()
    assert pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider"], [collected]) == 0
    assert {name.split("/")[1] for name in collected.names} == {"fk", "mass_properties"}


class Collected:
    """Plugin that stores what pytest collects."""

    names: list[str]

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.names = [item.nodeid for item in session.items]


# -- the steps before the twin


@pytest.mark.parametrize("suffix", [".zip", ".tar.gz"])
def test_another_archive_is_named_when_it_is_taken_into_the_same_folder(
    tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = supply(tmp_path)
    archive, out = pack(folder, tmp_path / f"supplier{suffix}"), tmp_path / "arm"
    words = ["intake", str(archive), "--out", str(out)]
    assert main(words) == 0
    assert main(words) == 2
    assert f"the archive supplier{suffix}, unchanged" in capsys.readouterr().err
    edit(folder / "arm_description/urdf/arm.urdf", b'value="2"', b'value="3"')
    pack(folder, archive)
    assert main(words) == 2
    assert f"another archive than supplier{suffix} of its intake" in capsys.readouterr().err


@pytest.fixture
def intake(walk: Walk, tmp_path: Path) -> Path:
    """A separate copy of the asset."""
    return Path(shutil.copytree(walk.intake, tmp_path / "arm"))


def _change_mesh(intake: Path) -> str:
    path = intake / "source/arm_description/meshes/part.stl"
    write(path, path.read_bytes() + b"\0")
    return "source/arm_description/meshes/part.stl was changed"


def _remove_mesh(intake: Path) -> str:
    (intake / "source/arm_description/meshes/part.dae").unlink()
    return "source/arm_description/meshes/part.dae: no such file"


def _add_file(intake: Path) -> str:
    (intake / "source/notes.txt").write_text("x")
    return "source/notes.txt was added"


@pytest.mark.parametrize("change", [_change_mesh, _remove_mesh, _add_file])
@pytest.mark.parametrize("command", ["realize", "init"])
def test_realize_and_init_refuse_a_changed_source(
    intake: Path, change: Callable[[Path], str], command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = change(intake)
    model = "source/arm_description/urdf/arm.urdf" if command == "realize" else "arm.xml"
    assert main([command, str(intake / model), "--out", str(intake.parent / "new")]) == 2
    printed = capsys.readouterr().err
    assert f"the source asset has changed since intake: {words}" in printed
    assert not (intake.parent / "new/twin.yaml").exists()


def test_a_realization_in_another_folder_keeps_the_source(intake: Path, tmp_path: Path) -> None:
    out = tmp_path / "elsewhere"
    urdf = intake / "source/arm_description/urdf/arm.urdf"
    for _ in range(2):
        assert main(["realize", str(urdf), "--out", str(out)]) == 0
    known = manifest.read(out / "manifest.json")
    assert known.states["source"] == manifest.read(intake / "manifest.json").states["source"]
    assert manifest.changes_of_source(out / "manifest.json", known) == []
    edit(out / "source/docs/naming_table.csv", b"J1", b"J2")
    (changed,) = manifest.changes_of_source(out / "manifest.json", known)
    assert changed.file == "source/docs/naming_table.csv"


def test_an_edited_file_is_not_overwritten_by_realize(
    intake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(intake / "arm.xml", b'mass="1.5"', b'mass="1.6"')
    edited = (intake / "arm.xml").read_bytes()
    words = ["realize", str(intake / "source/arm_description/urdf/arm.urdf"), "--out", str(intake)]
    assert main(words) == 2
    assert "arm.xml: was written or changed by somebody else" in capsys.readouterr().err
    assert (intake / "arm.xml").read_bytes() == edited
    (intake / "arm.xml").unlink()
    assert main(words) == 0


def test_a_manifest_of_another_tool_or_of_the_supplier_is_ignored(tmp_path: Path) -> None:
    folder = supply(tmp_path)
    (folder / "manifest.json").write_text('{"name": "arm", "version": 3}')
    (folder / "source").mkdir()
    shutil.move(folder / "arm_description", folder / "source")
    # As above a twin in the checkout of a web page.
    (tmp_path / "manifest.json").write_text('{"start_url": "/"}')
    (tmp_path / "source").mkdir()
    out = tmp_path / "arm"
    assert main(["intake", str(folder), "--out", str(out)]) == 0
    urdf = out / "source/source/arm_description/urdf/arm.urdf"
    asset = manifest.find(urdf)
    assert asset is not None
    assert asset[0] == out / "manifest.json"
    assert main(["realize", str(urdf), "--out", str(out)]) == 0


def test_of_an_asset_inside_a_delivery_the_outer_manifest_counts(intake: Path) -> None:
    out = intake.parent / "again"
    assert main(["intake", str(intake), "--out", str(out)]) == 0
    asset = manifest.find(out / "source/source/arm_description/urdf/arm.urdf")
    assert asset is not None
    assert asset[0] == out / "manifest.json"


def test_a_twin_of_the_source_urdf_keeps_the_asset_too(intake: Path, tmp_path: Path) -> None:
    twin = tmp_path / "twin"
    urdf = intake / "source/arm_description/urdf/arm.urdf"
    assert main(["init", str(urdf), "--out", str(twin)]) == 0
    stated = yaml.safe_load((twin / "twin.yaml").read_text())
    assert stated["model"] == URDF.as_posix()
    assert manifest.find((twin / URDF).resolve()) is not None


def test_a_twin_around_the_asset_copies_nothing(intake: Path) -> None:
    assert main(["init", str(intake / "arm.xml"), "--out", str(intake)]) == 0
    stated = yaml.safe_load((intake / "twin.yaml").read_text())
    assert stated["model"] == "arm.xml"
    assert "source/arm_description/urdf/arm.urdf" in stated["source"]
    assert not (intake / "asset").exists()


def test_without_intake_the_twin_says_that_the_source_is_not_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = write_arm(tmp_path / "supplied")
    assert main(["realize", str(urdf), "--out", str(tmp_path / "arm")]) == 0
    assert main(["init", str(tmp_path / "arm/arm.xml"), "--out", str(tmp_path / "twin")]) == 0
    assert "the supplier's files are not kept beside it" in capsys.readouterr().out
    assert "source" not in yaml.safe_load((tmp_path / "twin/twin.yaml").read_text())


def test_a_twin_inside_the_source_is_refused(
    intake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = intake / "source/arm_description/urdf/arm.urdf"
    before = sorted(intake.rglob("*"))
    assert main(["init", str(urdf), "--out", str(urdf.parent)]) == 2
    assert "the twin would be inside the source of an asset" in capsys.readouterr().err
    assert sorted(intake.rglob("*")) == before


def test_a_manifest_with_a_path_outside_the_asset_is_refused(
    intake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = intake / "manifest.json"
    known = manifest.read(path)
    normalized = known.states["normalized"]
    facts = {**normalized.facts, "reports": ["../../secret.txt"]}
    states = {**known.states, "normalized": manifest.State(normalized.files, facts)}
    manifest.write(path, manifest.Manifest(known.asset, states))
    assert main(["init", str(intake / "arm.xml"), "--out", str(tmp_path / "twin")]) == 2
    assert "states.normalized.reports" in capsys.readouterr().err


def test_a_state_made_from_another_source_is_refused(
    intake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = intake / "manifest.json"
    known = manifest.read(path)
    other = {**known.states["source"].files, "source/new.txt": "0" * 64}
    states = {**known.states, "source": manifest.State(other, known.states["source"].facts)}
    manifest.write(path, manifest.Manifest(known.asset, states))
    assert main(["init", str(intake / "arm.xml"), "--out", str(tmp_path / "twin")]) == 2
    assert "the normalized state was made from another version" in capsys.readouterr().err
