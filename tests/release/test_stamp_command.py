"""``pytest-twin stamp`` and ``verify`` of data sets in all supported file formats."""

from __future__ import annotations

import json
import random
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.errors import SimulationError, TwinError
from pytest_twin.formats.schema import load_schema
from pytest_twin.formats.stamps import carriers_of
from pytest_twin.realization import confinement
from pytest_twin.release.stamp_sandbox import ParsedInChild, carriers_in_child

sys.path.append(str(Path(__file__).parents[1] / "formats"))

from lerobot_files import episode, write_dataset

KINDS = ("lerobot", "mcap", "hdf5", "onnx")


def write_mcap(path: Path, messages: int = 300) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1024, enable_data_crcs=True)
        writer.start(profile="ros2", library="test")
        writer.add_metadata("trial", {"role": "fit"})
        schema = writer.register_schema("text", "jsonschema", b"{}")
        channel = writer.register_channel("/said", "json", schema)
        for i in range(messages):
            writer.add_message(channel, i * 1000, json.dumps({"i": i}).encode(), i * 1000)
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"a note")
        writer.finish()
    return path


def messages_of(path: Path) -> list[tuple[int, bytes]]:
    """Log times and data, read through the file's index with the mcap library."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(m.log_time, m.data) for _, _, m in reader.iter_messages(log_time_order=False)]


def write(kind: str, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "lerobot":
        return write_dataset(folder / "set", [episode(0, 30), episode(1, 20)])
    if kind == "mcap":
        return write_mcap(folder / "move.mcap")
    if kind == "hdf5":
        import h5py

        with h5py.File(folder / "demo.hdf5", "w") as file:
            file.attrs["env"] = "kitchen"
            file.create_dataset("data/demo_0/actions", data=np.arange(40.0).reshape(20, 2))
            file.create_dataset("data/demo_0/names", data=["pan", "elbow"])
        return folder / "demo.hdf5"
    from onnx import TensorProto, helper, save

    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 2])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2])
    weights = helper.make_tensor("w", TensorProto.FLOAT, [1, 2], [1.0, 2.0])
    graph = helper.make_graph(
        [helper.make_node("Mul", ["x", "w"], ["y"])], "policy", [x], [y], [weights]
    )
    model = helper.make_model(graph)
    helper.set_model_props(model, {"trained": "yesterday"})
    save(model, folder / "policy.onnx")
    return folder / "policy.onnx"


def tamper(kind: str, path: Path) -> None:
    """Change one value of the content."""
    if kind == "lerobot":
        info = json.loads((path / "meta/info.json").read_text())
        (path / "meta/info.json").write_text(json.dumps({**info, "fps": 51}))
    elif kind == "mcap":
        data = bytearray(path.read_bytes())
        at = data.index(b"a note")
        data[at] = ord("A")
        path.write_bytes(data)
    elif kind == "hdf5":
        import h5py

        with h5py.File(path, "r+") as file:
            file["data/demo_0/actions"][3, 1] += 1e-6
    else:
        import onnx

        model = onnx.load(path)
        model.graph.initializer[0].float_data[0] += 0.5
        onnx.save(model, path)


@pytest.fixture
def twin_with_two_releases(root: Path, make: MakeRelease) -> Path:
    for _ in range(2):
        make(datetime.now(UTC))
    return root


@pytest.mark.parametrize("kind", KINDS)
def test_a_stamp_is_valid_until_the_data_change(
    kind: str, twin_with_two_releases: Path, tmp_path: Path
) -> None:
    data = write(kind, tmp_path / "data")
    assert (
        cli.main(
            ["stamp", str(data), "--release", str(twin_with_two_releases / "releases" / "0001")]
        )
        == 0
    )
    assert cli.main(["verify", str(data)]) == 0
    # A second stamp replaces the first.
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 0
    out = tmp_path / "verdict.json"
    assert cli.main(["verify", str(data), "--json", str(out)]) == 0
    verdict = json.loads(out.read_text())
    jsonschema.validate(verdict, load_schema("results/verify.schema.json"))
    assert verdict["stamp"]["release"] == verdict["release"]["number"] == 2
    # The release declares a controller and a payload; no data name theirs.
    assert verdict["stamp"]["controller"]["id"] is verdict["stamp"]["payload"]["id"] is None
    tamper(kind, data)
    assert cli.main(["verify", str(data), "--json", str(out)]) == 1
    (problem,) = json.loads(out.read_text())["problems"]
    assert problem["text"].startswith("the data have changed since they were stamped")


def test_a_file_in_a_store_is_not_stamped_and_its_stamp_is_read_through_the_link(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = tmp_path / "data/.git/annex/objects/aa/key"
    content.parent.mkdir(parents=True)
    path = write("mcap", tmp_path)
    stamped(path, twin_with_two_releases)
    shutil.move(path, content)
    link = tmp_path / "data/move.mcap"
    link.symlink_to(".git/annex/objects/aa/key")
    assert cli.main(["verify", str(link)]) == 0
    stamped(link, twin_with_two_releases, status=2)
    assert "is a link into a store, whose files must not change" in capsys.readouterr().err
    tamper("mcap", content)
    assert cli.main(["verify", str(link)]) == 1


def test_the_stamp_of_a_linked_data_set_names_the_folder_behind_the_link(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    data = write("lerobot", tmp_path / "store")
    (tmp_path / "current").symlink_to(data)
    (file,) = stamped(tmp_path / "current", twin_with_two_releases)["files"]
    assert file["target"] == str(data)
    assert cli.main(["verify", str(tmp_path / "current")]) == 0


def test_a_link_out_of_a_data_set_is_not_passed_over(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").mkdir()
    write("mcap", tmp_path / "data")
    (tmp_path / "data/other.mcap").symlink_to(write("mcap", tmp_path / "elsewhere"))
    stamped(tmp_path / "data", twin_with_two_releases, status=2)
    assert "other.mcap: is a link to another folder" in capsys.readouterr().err


def write_trial(path: Path, **metadata: str) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("trial", metadata)
        writer.finish()
    return path


def stamped(data: Path, twin: Path, *options: str, status: int = 0) -> dict[str, Any]:
    out = data.parent / "stamp.json"
    assert (
        cli.main(["stamp", str(data), "--release", str(twin), "--json", str(out), *options])
        == status
    )
    return json.loads(out.read_text()) if status == 0 else {}


def test_the_stamp_names_the_payload_and_controller_of_the_data(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    by_option = stamped(
        write("hdf5", tmp_path),
        twin_with_two_releases,
        "--payload",
        "kg05",
        "--controller",
        "kp100",
    )
    assert (by_option["payload"]["id"], by_option["controller"]["id"]) == ("kg05", "kp100")
    assert cli.main(["verify", str(tmp_path / "demo.hdf5")]) == 0
    by_metadata = stamped(
        write_trial(tmp_path / "trial.mcap", payload="kg05"), twin_with_two_releases
    )
    assert (by_metadata["payload"]["id"], by_metadata["controller"]["id"]) == ("kg05", None)
    assert cli.main(["verify", str(tmp_path / "trial.mcap")]) == 0


def test_recordings_of_one_data_set_may_have_different_payloads(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    write_trial(folder / "a.mcap", payload="kg05")
    write_trial(folder / "b.mcap", payload="kg10")
    stamped(folder, twin_with_two_releases)
    assert "payload      kg05, kg10" in capsys.readouterr().out
    assert cli.main(["verify", str(folder)]) == 0


def test_a_payload_that_the_release_does_not_declare_is_not_stamped(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write("hdf5", tmp_path)
    stamped(data, twin_with_two_releases, "--payload", "kg99", status=2)
    output = capsys.readouterr().err
    assert "payload: release 2 has no payload of this name (got 'kg99'; expected one of" in output
    trial = write_trial(tmp_path / "trial.mcap", payload="a bottle")
    assert stamped(trial, twin_with_two_releases)["payload"]["id"] is None
    assert "names payload 'a bottle', which release 2 does not declare" in capsys.readouterr().out
    stamped(trial, twin_with_two_releases, "--payload", "kg05", status=2)
    output = capsys.readouterr().err
    assert "payload: its metadata name another payload (got 'a bottle'; expected kg05" in output


def test_a_stamp_with_another_payload_than_the_release_declares_does_not_hold(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    data = write("lerobot", tmp_path)
    stamped(data, twin_with_two_releases, "--payload", "kg05")
    file = data / "meta/twin.json"
    fields = json.loads(file.read_text())
    fields["payload"]["id"] = "kg99"
    file.write_text(json.dumps(fields))
    out = tmp_path / "verdict.json"
    assert cli.main(["verify", str(data), "--json", str(out)]) == 1
    (problem,) = json.loads(out.read_text())["problems"]
    assert "payload: the stamp says" in problem["text"]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_changed_frame_of_a_lerobot_data_set_is_detected(
    version: str, twin_with_two_releases: Path, tmp_path: Path
) -> None:
    data = write_dataset(tmp_path / "set", [episode(0, 30), episode(1, 20)], version)
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 0
    assert json.loads((data / "meta/twin.json").read_text())["release"] == 2
    assert cli.main(["verify", str(data)]) == 0
    file = sorted((data / "data").rglob("*.parquet"))[0]
    frames = pq.read_table(file)
    rows = frames["observation.state"].to_pylist()
    rows[3][1] += 0.3
    column = pa.array(rows, frames["observation.state"].type)
    at = frames.column_names.index("observation.state")
    pq.write_table(frames.set_column(at, "observation.state", column), file)
    assert cli.main(["verify", str(data)]) == 1


def test_stamping_leaves_the_other_content_unchanged(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    import h5py
    import onnx

    for kind in KINDS:
        write(kind, tmp_path)
    before = messages_of(tmp_path / "move.mcap")
    for _ in range(2):
        assert (
            cli.main(["stamp", str(tmp_path / "set"), "--release", str(twin_with_two_releases)])
            == 0
        )
        for name in ("move.mcap", "demo.hdf5", "policy.onnx"):
            assert (
                cli.main(["stamp", str(tmp_path / name), "--release", str(twin_with_two_releases)])
                == 0
            )
    assert messages_of(tmp_path / "move.mcap") == before
    assert len(before) == 300
    with h5py.File(tmp_path / "demo.hdf5") as file:
        assert file.attrs["env"] == "kitchen"
        assert file["data/demo_0/actions"][19, 1] == 39.0
        assert json.loads(file.attrs["twin"] + file.attrs.get("twin_1", ""))["twin"] == "arm"
    model = onnx.load(tmp_path / "policy.onnx")
    onnx.checker.check_model(model)
    props = {p.key: p.value for p in model.metadata_props}
    assert props["trained"] == "yesterday"
    assert json.loads(props["twin"])["release"] == 2


def test_a_stamped_mcap_file_has_a_complete_index(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    from mcap.reader import make_reader

    path = write("mcap", tmp_path)
    for _ in range(3):
        assert cli.main(["stamp", str(path), "--release", str(twin_with_two_releases)]) == 0
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics.message_count == 300
        assert summary.statistics.metadata_count == 2
        assert [m.name for m in reader.iter_metadata()] == ["trial", "twin"]
        assert [a.data for a in reader.iter_attachments()] == [b"a note"]
        late = [m.log_time for _, _, m in reader.iter_messages(starting_at=290_000)]
        assert late == [i * 1000 for i in range(290, 300)]


def write_joints(path: Path, *messages: tuple[str, ...]) -> Path:
    """An MCAP file whose messages name joints, as JSON."""
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/arm/joint_states", "json", 0)
        for at, names in enumerate(messages):
            text = json.dumps({"name": names, "position": [0.1] * len(names)})
            writer.add_message(channel, at * 10**7, text.encode(), at * 10**7)
        writer.finish()
    return path


def data_naming(kind: str, folder: Path, *names: str) -> Path:
    if kind == "mcap":
        return write_joints(folder / "move.mcap", names)
    return write_dataset(folder / "set", [episode(0, 30)], names=names)


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_data_of_another_robot_are_not_stamped(
    kind: str, twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = data_naming(kind, tmp_path, "wheel_left", "wheel_right")
    stamped(data, twin_with_two_releases, status=2)
    assert (
        "data of another robot: release 2 has none of its joints (got 'wheel_left, wheel_right'; "
        "expected elbow_flex, shoulder_pan; --joints RECORDED=RELEASED"
    ) in capsys.readouterr().err
    assert cli.main(["verify", str(data)]) == 2
    # With the mapping, and with the statement that these are no joints, both are stamped.
    mapping = "wheel_left=shoulder_pan,wheel_right=elbow_flex"
    for option in (mapping, "none"):
        (file,) = stamped(data, twin_with_two_releases, "--joints", option)["files"]
        assert file["unknown_joints"] == []
        assert cli.main(["verify", str(data)]) == 0
    stamped(data, twin_with_two_releases, "--joints", "wheel_left=shoulder_pan")
    assert "note: " + data.name + ": not joints of the release: wheel_right" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_a_stamp_that_an_earlier_version_put_on_data_of_another_robot_does_not_hold(
    kind: str, twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = data_naming(kind, tmp_path, "wheel_left", "wheel_right")
    stamped(data, twin_with_two_releases, "--joints", "none")
    (carrier,) = carriers_of(data)
    text = carrier.read()
    assert text is not None
    without = {name: value for name, value in json.loads(text).items() if name != "joints"}
    carrier.write(json.dumps(without))
    for command in (["verify", str(data)], ["fresh", str(data)]):
        assert cli.main(command) in (1, 2)
        output = capsys.readouterr()
        assert "data of another robot: not joints of the release: wheel_left" in (
            output.out + output.err
        )


def test_joints_beyond_the_release_and_in_later_messages_are_noted(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first message is of a gripper's driver, which the twin does not model."""
    data = write_joints(tmp_path / "both.mcap", ("finger",), ("shoulder_pan", "elbow_flex"))
    (file,) = stamped(data, twin_with_two_releases)["files"]
    assert file["unknown_joints"] == ["finger"]
    out = tmp_path / "verdict.json"
    assert cli.main(["verify", str(data), "--json", str(out)]) == 0
    (file,) = json.loads(out.read_text())["files"]
    assert file["note"] == "not joints of the release: finger"
    assert f"note: {data}: not joints of the release: finger" in capsys.readouterr().out


def test_data_without_names_of_joints_are_stamped(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    data = write_dataset(tmp_path / "set", [episode(0, 30)], names=None)
    (file,) = stamped(data, twin_with_two_releases)["files"]
    assert file["unknown_joints"] == []


def edit(path: Path, **changes: object) -> None:
    file = path / "meta/twin.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"release": 1}, "release: the stamp says 1, release 2 says 2"),
        ({"calibration": {"id": "other", "digest": "00"}}, "calibration: the stamp says"),
        ({"declared": {}}, "declared: the stamp says {}"),
        ({"stamped": "2020-01-01T00:00:00Z"}, "before the release or in the future"),
        ({"envelope": {}}, "not a DSSE envelope"),
        ({"more": 1}, "not a stamp of pytest-twin"),
    ],
)
def test_an_edited_stamp_is_invalid(
    changes: dict[str, object],
    said: str,
    twin_with_two_releases: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = write("lerobot", tmp_path)
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 0
    edit(data, **changes)
    assert cli.main(["verify", str(data)]) == 1
    assert said in capsys.readouterr().out


def test_a_stamp_of_an_untrusted_release_is_invalid(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from securesystemslib.signer import CryptoSigner

    from pytest_twin.release.keys import public_pem

    data = write("lerobot", tmp_path)
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 0
    keys = tmp_path / "mine"
    keys.mkdir()
    (keys / "me.pub").write_bytes(public_pem(CryptoSigner.generate_ed25519()))
    assert cli.main(["verify", str(data), "--keys", str(keys)]) == 1
    assert "not trusted" in capsys.readouterr().out
    assert cli.main(["verify", str(data), "--keys", str(twin_with_two_releases / "keys")]) == 0


def test_all_files_of_a_data_set_must_have_the_same_release(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    for name in ("a.mcap", "b.mcap"):
        write_mcap(folder / name)
    assert cli.main(["stamp", str(folder), "--release", str(twin_with_two_releases)]) == 0
    assert cli.main(["verify", str(folder)]) == 0
    older = str(twin_with_two_releases / "releases" / "0001")
    assert cli.main(["stamp", str(folder / "b.mcap"), "--release", older]) == 0
    assert cli.main(["verify", str(folder)]) == 1
    assert "other files with release 2" in capsys.readouterr().out
    write_mcap(folder / "b.mcap")
    assert cli.main(["verify", str(folder)]) == 1
    assert "b.mcap: is not stamped" in capsys.readouterr().out


def test_data_that_cannot_be_stamped_are_reported_in_one_line_and_unchanged(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write("mcap", tmp_path)
    whole = data.read_bytes()
    data.write_bytes(whole[:-40])
    broken = data.read_bytes()
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 2
    assert "no footer" in capsys.readouterr().err
    assert data.read_bytes() == broken
    (tmp_path / "a.csv").write_text("time\n")
    assert (
        cli.main(["stamp", str(tmp_path / "a.csv"), "--release", str(twin_with_two_releases)]) == 2
    )
    assert "pytest-twin convert" in capsys.readouterr().err
    data.write_bytes(whole)
    (twin_with_two_releases / "releases" / "0002" / "results.json").write_text("{}")
    assert cli.main(["stamp", str(data), "--release", str(twin_with_two_releases)]) == 2
    assert "the release does not hold: results.json: changed" in capsys.readouterr().err
    assert data.read_bytes() == whole
    assert cli.main(["verify", str(data)]) == 2
    assert "is not stamped" in capsys.readouterr().err


def test_a_stamp_stays_valid_after_newer_releases_and_without_the_twin(
    twin_with_two_releases: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write("lerobot", tmp_path)
    assert (
        cli.main(
            ["stamp", str(data), "--release", str(twin_with_two_releases / "releases" / "0001")]
        )
        == 0
    )
    keys = tmp_path / "keys"
    shutil.copytree(twin_with_two_releases / "keys", keys)
    shutil.rmtree(twin_with_two_releases)
    assert cli.main(["verify", str(data), "--keys", str(keys)]) == 0
    assert cli.main(["verify", str(data)]) == 2


@pytest.mark.parametrize("kind", ["mcap", "hdf5", "onnx"])
def test_reading_a_damaged_file_raises_only_typed_errors(kind: str, tmp_path: Path) -> None:
    path = write(kind, tmp_path)
    (carrier,) = carriers_of(path)
    carrier.write('{"a": 1}')
    whole, draw = path.read_bytes(), random.Random(0)
    refused = 0
    for number in range(60):
        data = bytearray(whole)
        if number % 3 == 0:
            data = data[: draw.randrange(len(data))]
        else:
            data[-1 - draw.randrange(min(len(data), 300))] = draw.randrange(256)
        path.write_bytes(data)
        for read in (carrier.read, carrier.digest, lambda: carrier.write("{}")):
            try:
                read()
            except TwinError:
                refused += 1
    assert refused >= 60


@pytest.mark.parametrize("kind", ["hdf5", "onnx"])
def test_hdf5_and_onnx_files_are_parsed_in_a_child_process(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parent process reads the stamp although it cannot import the library."""
    path = write(kind, tmp_path)
    (carrier,) = carriers_in_child(path, writable=True)
    carrier.write('{"a": 1}')
    for library in ("h5py", "onnx"):
        monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(TwinError, match="which is not installed"):
        carriers_of(path)[0].read()
    assert carrier.read() == '{"a": 1}'
    assert len(carrier.digest()) == 64


def test_a_parse_error_in_the_child_process_keeps_its_message(tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    (carrier,) = carriers_in_child(path, writable=True)
    with pytest.raises(TwinError, match=r"demo\.hdf5: cannot be read as HDF5"):
        carrier.read()


@pytest.mark.skipif(
    confinement.why_not_confined() is not None, reason=str(confinement.why_not_confined())
)
def test_the_child_that_opens_a_stamped_file_reaches_no_file_outside_the_data(
    tmp_path: Path,
) -> None:
    pytest.importorskip("h5py")
    import h5py

    data, elsewhere = tmp_path / "data", tmp_path / "elsewhere"
    data.mkdir()
    elsewhere.mkdir()
    with h5py.File(data / "demo.hdf5", "w") as file:
        file["action"] = [1.0, 2.0]
    (read,) = carriers_in_child(data / "demo.hdf5", writable=False)
    (written,) = carriers_in_child(data / "demo.hdf5", writable=True)
    assert isinstance(read, ParsedInChild)
    assert read.digest() == written.digest()
    assert read.sandbox.call("os:listdir", {"path": str(data)}) == ["demo.hdf5"]
    with pytest.raises(SimulationError, match="PermissionError"):
        read.sandbox.call("os:listdir", {"path": str(elsewhere)})
    with pytest.raises(SimulationError, match="PermissionError"):
        read.sandbox.call("os:mkdir", {"path": str(data / "new")})
    assert isinstance(written, ParsedInChild)
    written.write('{"a": 1}')
    assert read.read() == '{"a": 1}'
    for call, arguments in (("listdir", {"path": str(elsewhere)}),
                            ("mkdir", {"path": str(elsewhere / "new")})):  # fmt: skip
        with pytest.raises(SimulationError, match="PermissionError"):
            written.sandbox.call(f"os:{call}", arguments)
