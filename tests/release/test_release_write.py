"""Writing releases: atomic, without overwriting, and only with a trusted key."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
from release_twins import NOW, MakeRelease, html, make_draft, make_twin, outcome, sha256
from securesystemslib.signer import CryptoSigner

from pytest_twin import release
from pytest_twin.errors import ReleaseError
from pytest_twin.formats import temporary


def test_a_release_contains_header_ids_parts_proofs_and_files_of_its_draft(
    root: Path, make: MakeRelease
) -> None:
    draft = make_draft(root)
    written = make()
    read = release.check(root / "releases" / "0001", now=NOW).release
    assert read == written
    assert written.twin == "arm"
    assert written.number == 1
    assert written.header.previous is None
    assert written.header.created == "2026-05-04T12:00:00Z"
    assert written.header.expires == "2026-08-02T12:00:00Z"
    assert written.ids == draft.ids
    assert {i: p.digest for i, p in written.parts.items()} == {
        i: p.digest for i, p in draft.parts.items()
    }
    assert written.parts["library:pin"].content == {"version": "4.1.0"}
    proof = written.goldens["golden/fk/home@mujoco"]
    assert proof.outcome == replace(outcome(), plot=None)
    assert (proof.release, proof.at) == (1, "2026-05-04T12:00:00Z")
    assert {entry.name for entry in written.files} == {
        "results.json",
        "report.html",
        "files/twin.yaml",
        "files/arm.xml",
        "files/meshes/link.stl",
        "files/golden/fk/home.yaml",
    }
    for name in ("arm.xml", "meshes/link.stl"):
        copy = root / "releases" / "0001" / "files" / name
        assert copy.read_bytes() == (root / name).read_bytes()


def test_the_envelope_is_a_dsse_envelope_that_openssl_verifies(
    root: Path, make: MakeRelease
) -> None:
    """Compared with OpenSSL's Ed25519 and the DSSE and in-toto specifications."""
    import base64

    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    make()
    envelope = json.loads((root / "releases" / "0001" / "release.dsse.json").read_bytes())
    payload = base64.standard_b64decode(envelope["payload"])
    kind = envelope["payloadType"].encode()
    assert kind == b"application/vnd.in-toto+json"
    pae = b"DSSEv1 %d %s %d %s" % (len(kind), kind, len(payload), payload)
    (key,) = (root / "keys").glob("*.pub")
    public = load_pem_public_key(key.read_bytes())
    public.verify(base64.standard_b64decode(envelope["signatures"][0]["sig"]), pae)  # type: ignore
    statement = json.loads(payload)
    assert statement["_type"] == "https://in-toto.io/Statement/v1"
    subjects = {s["name"]: s["digest"]["sha256"] for s in statement["subject"]}
    assert subjects["files/arm.xml"] == sha256(root / "arm.xml")
    (golden,) = statement["predicate"]["goldens"]
    assert golden["outcome"]["measures"][0]["margin"] == pytest.approx(3e-4)


def test_results_are_written_as_json_and_as_an_html_report(root: Path, make: MakeRelease) -> None:
    make()
    make()
    results = json.loads((root / "releases" / "0002" / "results.json").read_text())
    assert (results["twin"], results["release"]) == ("arm", 2)
    assert results["goldens"][0]["release"] == 2
    assert "release 2" in (root / "releases" / "0002" / "report.html").read_text()


def test_release_numbers_increase_and_each_release_names_its_predecessor(
    root: Path, make: MakeRelease
) -> None:
    first, second = make(), make()
    assert second.number == 2
    assert second.header.series == first.header.series
    assert second.header.previous == release.Previous(1, first.sha256)


def test_a_carried_over_proof_keeps_its_release_and_time(root: Path, make: MakeRelease) -> None:
    first = make()
    old = first.goldens["golden/fk/home@mujoco"]
    signer, _ = release.signer(root)
    draft = replace(make_draft(root), proofs=(old,))
    second, _ = release.write(root, draft, signer, html, now=NOW + timedelta(days=3))
    proof = second.goldens["golden/fk/home@mujoco"]
    assert (proof.release, proof.at) == (1, "2026-05-04T12:00:00Z")


def test_files_outside_the_twin_are_listed_and_not_copied(root: Path, tmp_path: Path) -> None:
    recording = tmp_path / "recordings" / "a.mcap"
    recording.parent.mkdir()
    recording.write_bytes(b"mcap")
    signer, _ = release.signer(root)
    written, _ = release.write(root, make_draft(root, recording), signer, html)
    assert written.external == (release.FileEntry("../recordings/a.mcap", sha256(recording), 4),)
    assert not list((root / "releases").rglob("*.mcap"))


def test_a_file_changed_during_the_run_prevents_the_release(root: Path) -> None:
    draft = make_draft(root)
    (root / "arm.xml").write_text("<mujoco/>")
    signer, _ = release.signer(root)
    with pytest.raises(ReleaseError, match=r"arm\.xml: changed during the run"):
        release.write(root, draft, signer, html)
    assert list((root / "releases").iterdir()) == []
    assert not (root / "keys").exists()


@pytest.mark.parametrize("status", ["failed", "error"])
def test_a_critical_failure_prevents_the_release(root: Path, status: str) -> None:
    signer, _ = release.signer(root)
    draft = make_draft(root, result=outcome(status))
    with pytest.raises(ReleaseError, match="home@mujoco: a critical golden did not pass"):
        release.write(root, draft, signer, html)
    assert not (root / "releases").exists()


def test_an_advisory_failure_is_released_with_its_status(root: Path) -> None:
    signer, _ = release.signer(root)
    draft = make_draft(root, result=outcome("failed", "advisory", error=float("nan")))
    release.write(root, draft, signer, html, now=NOW)
    read = release.check(root / "releases" / "0001", now=NOW).release
    assert read is not None
    (proof,) = read.goldens.values()
    assert proof.outcome.status == "failed"
    assert not proof.outcome.measures[0].passed


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("LINK.stl", r"files/meshes/LINK_stl-[0-9a-f]{8}\.stl"),
        ("a:b.stl", r"files/meshes/a_b_stl-[0-9a-f]{8}\.stl"),
        ("con.stl", r"files/meshes/con_stl-[0-9a-f]{8}\.stl"),
        ("dot.", r"files/meshes/dot-[0-9a-f]{8}"),
    ],
)
def test_a_file_with_an_unportable_name_is_stored_under_a_portable_name(
    root: Path, given: str, kept: str
) -> None:
    (root / "meshes" / given).write_bytes(b"other")
    signer, _ = release.signer(root)
    release.write(root, make_draft(root), signer, html, now=NOW)
    verdict = release.check(root / "releases" / "0001", now=NOW)
    assert verdict.holds
    assert verdict.release is not None
    (entry,) = [e for e in verdict.release.files if e.original == f"meshes/{given}"]
    assert re.fullmatch(kept, entry.name)
    assert (root / "releases" / "0001" / entry.name).read_bytes() == b"other"


# interrupted and concurrent writes


def test_a_killed_writer_leaves_no_release(root: Path, user: Path) -> None:
    code = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from release_twins import make_draft
from pytest_twin import release
root = Path({str(root)!r})
signer, _ = release.signer(root)
release.write(root, make_draft(root), signer, lambda header: os.kill(os.getpid(), signal.SIGKILL))
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    (staging,) = (root / "releases").iterdir()
    assert staging.name.startswith(temporary.PREFIX)
    assert release.newest(root) is None
    assert release.baseline(root) == release.Baseline(None, None, ())
    assert not release.check(staging).holds
    # The next release removes what the killed one left.
    signer, _ = release.signer(root)
    release.write(root, make_draft(root), signer, html)
    assert [path.name for path in (root / "releases").iterdir()] == ["0001"]


def test_a_symbolic_link_at_the_next_release_number_is_not_followed(
    root: Path, tmp_path: Path, make: MakeRelease
) -> None:
    make()
    (tmp_path / "elsewhere").mkdir()
    (root / "releases" / "0002").symlink_to(tmp_path / "elsewhere")
    assert make().number == 3
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_failed_write_leaves_no_files(root: Path) -> None:
    signer, _ = release.signer(root)

    def broken(header: release.Header) -> str:
        raise RuntimeError("no report")

    with pytest.raises(RuntimeError):
        release.write(root, make_draft(root), signer, broken)
    assert list((root / "releases").iterdir()) == []


def test_of_two_concurrent_writers_the_second_reports_an_error(
    root: Path, make: MakeRelease
) -> None:
    signer, _ = release.signer(root)

    def report_after_another_writer(header: release.Header) -> str:
        # Another process writes the same release number in the meantime.
        assert make().number == header.number
        return "late"

    with pytest.raises(ReleaseError, match="release 1 was written by another process meanwhile"):
        release.write(root, make_draft(root), signer, report_after_another_writer, now=NOW)
    assert [path.name for path in (root / "releases").iterdir()] == ["0001"]
    assert release.check(root / "releases" / "0001", now=NOW).holds


def test_a_release_written_between_reading_and_writing_is_not_skipped(
    root: Path, make: MakeRelease, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the next release would name the wrong predecessor and never be valid."""
    make()
    signer, _ = release.signer(root)
    read_baseline = release.write.__globals__["baseline"]

    def read_baseline_then_write(*args: object, **options: object) -> object:
        found = read_baseline(*args, **options)
        monkeypatch.setitem(release.write.__globals__, "baseline", read_baseline)
        assert make().number == 2
        return found

    monkeypatch.setitem(release.write.__globals__, "baseline", read_baseline_then_write)
    with pytest.raises(ReleaseError, match="release 2 was written by another process meanwhile"):
        release.write(root, make_draft(root), signer, html, now=NOW)
    assert sorted(path.name for path in (root / "releases").iterdir()) == ["0001", "0002"]
    assert make().number == 3
    assert release.check(root / "releases" / "0003", now=NOW).holds


def test_parallel_writers_never_overwrite_each_other(root: Path, user: Path) -> None:
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from release_twins import html, make_draft
from pytest_twin import release
from pytest_twin.errors import ReleaseError
root = Path({str(root)!r})
signer, _ = release.signer(root)
for _ in range(5):
    try:
        print(release.write(root, make_draft(root), signer, html)[0].number)
    except ReleaseError as error:
        assert "meanwhile" in str(error), error
"""
    running = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    numbers = []
    for process in running:
        out, _ = process.communicate(timeout=120)
        assert process.returncode == 0
        numbers += [int(line) for line in out.split()]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))
    assert len(list((root / "keys").glob("*.pub"))) == 1
    assert sorted(path.name for path in (root / "releases").iterdir()) == [
        f"{number:04d}" for number in sorted(numbers)
    ]
    assert release.check(root / "releases" / f"{max(numbers):04d}").holds


# keys


def test_a_signing_key_is_created_for_a_user_without_one(root: Path, user: Path) -> None:
    _, notes = release.signer(root)
    path = user / "config" / "pytest-twin" / "signing_key.pem"
    assert notes == (f"created a signing key: {path} (keep it private, and keep a copy)",)
    assert path.stat().st_mode & 0o777 == 0o600
    before = path.read_bytes()
    assert release.signer(root)[1] == ()
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["signing_key.pem"]


def test_the_first_release_stores_the_trusted_public_key_and_reports_it(root: Path) -> None:
    signer, _ = release.signer(root)
    _, notes = release.write(root, make_draft(root), signer, html, now=NOW)
    (key,) = (root / "keys").glob("*.pub")
    assert notes == (f"first release: this twin now trusts {key}; commit this file",)
    assert b"PRIVATE" not in key.read_bytes()
    _, notes = release.write(root, make_draft(root), signer, html, now=NOW)
    assert notes == ()


def test_of_two_concurrent_first_signers_only_one_is_trusted(root: Path, tmp_path: Path) -> None:
    signers = [release.signer(root, str(private_key(tmp_path / f"{name}.pem")))[0] for name in "ab"]

    def report_after_another_writer(header: release.Header) -> str:
        release.write(root, make_draft(root), signers[0], html, now=NOW)
        return "late"

    with pytest.raises(ReleaseError, match="is not a key that this twin trusts"):
        release.write(root, make_draft(root), signers[1], report_after_another_writer, now=NOW)
    (key,) = (root / "keys").iterdir()
    assert signers[0].public_key.keyid.startswith(key.stem)
    assert sorted(path.name for path in root.iterdir() if path.name.startswith(".")) == []


def test_an_empty_key_folder_gets_the_key_of_the_first_release(
    root: Path, make: MakeRelease
) -> None:
    (root / "keys").mkdir()
    (root / "keys" / "README").write_text("who may sign\n")
    make()
    assert len(list((root / "keys").glob("*.pub"))) == 1
    assert release.check(root / "releases" / "0001", now=NOW).holds


def private_key(path: Path) -> Path:
    path.write_bytes(CryptoSigner.generate_ed25519().private_bytes)
    path.chmod(0o600)
    return path


def test_the_signing_key_is_taken_from_flag_then_environment_then_ini(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [private_key(tmp_path / f"{name}.pem") for name in ("flag", "variable", "ini")]
    ids = [release.signer(root, str(path))[0].public_key.keyid for path in paths]
    monkeypatch.setenv("TWIN_SIGNING_KEY", str(paths[1]))
    assert release.signer(root, str(paths[0]), str(paths[2]))[0].public_key.keyid == ids[0]
    assert release.signer(root, None, str(paths[2]))[0].public_key.keyid == ids[1]
    monkeypatch.delenv("TWIN_SIGNING_KEY")
    assert release.signer(root, None, str(paths[2]))[0].public_key.keyid == ids[2]


def test_an_untrusted_key_may_not_sign(root: Path, tmp_path: Path, make: MakeRelease) -> None:
    make()
    foreign = private_key(tmp_path / "foreign.pem")
    with pytest.raises(ReleaseError, match="is not a key that this twin trusts"):
        release.signer(root, str(foreign))
    signer = release.signer(make_twin(tmp_path / "other"), str(foreign))[0]
    with pytest.raises(ReleaseError, match="is not a key that this twin trusts"):
        release.write(root, make_draft(root), signer, html)
    assert release.newest(root) == root / "releases" / "0001"


def test_a_twin_with_releases_but_without_keys_trusts_no_new_key(
    root: Path, make: MakeRelease
) -> None:
    make()
    for key in (root / "keys").iterdir():
        key.unlink()
    with pytest.raises(ReleaseError, match="there are releases but no trusted keys"):
        make()


def test_a_signing_key_inside_the_twin_is_refused(root: Path) -> None:
    with pytest.raises(ReleaseError, match="is inside the twin"):
        release.signer(root, str(private_key(root / "key.pem")))


@pytest.mark.parametrize("content", [b"", b"hello", b"-----BEGIN PRIVATE KEY-----\nAA==\n"])
def test_an_invalid_signing_key_file_is_named(root: Path, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key.pem"
    path.write_bytes(content)
    with pytest.raises(ReleaseError, match=r"key\.pem: not a key to sign with .*Ed25519"):
        release.signer(root, str(path))


def test_a_signing_key_other_than_ed25519_is_refused(root: Path, tmp_path: Path) -> None:
    path = tmp_path / "ecdsa.pem"
    path.write_bytes(CryptoSigner.generate_ecdsa().private_bytes)
    with pytest.raises(ReleaseError, match="not a key to sign with"):
        release.signer(root, str(path))


def test_a_signing_key_readable_by_others_is_reported(root: Path, tmp_path: Path) -> None:
    path = private_key(tmp_path / "key.pem")
    path.chmod(0o644)
    assert release.signer(root, str(path))[1] == (
        f"other users can read the signing key: run chmod 600 {path}",
    )


# the baseline of the gate


def test_the_baseline_is_the_newest_valid_release(root: Path, make: MakeRelease) -> None:
    make()
    second = make()
    found = release.baseline(root, now=NOW)
    assert found.release == second == found.known
    assert found.problems == ()


def test_a_damaged_newest_release_does_not_make_an_older_one_the_baseline(
    root: Path, make: MakeRelease
) -> None:
    """Its envelope is authentic, so the previous release is outdated."""
    make()
    second = make()
    (root / "releases" / "0002" / "files" / "arm.xml").write_text("<mujoco>changed</mujoco>\n")
    found = release.baseline(root, now=NOW)
    assert found.release is None
    assert found.known == second
    assert "release 2 does not hold: files/arm.xml: changed" in found.problems[0]
    assert "release 1 does not hold: older than release 2" in found.problems[1]


def test_a_forged_newest_release_does_not_hide_the_valid_one(root: Path, make: MakeRelease) -> None:
    first = make()
    (root / "releases" / "0002").mkdir()
    (root / "releases" / "0002" / "release.dsse.json").write_text("{}")
    found = release.baseline(root, now=NOW)
    assert found.release == first
    assert found.problems == (
        "release 2 does not hold: not a DSSE envelope "
        "(expected payload, payloadType and signatures of keyid and sig)",
    )
    assert make().number == 3


def test_an_expired_release_is_known_but_is_not_the_baseline(root: Path, make: MakeRelease) -> None:
    first = make()
    found = release.baseline(root, now=NOW + timedelta(days=90))
    assert found.release is None
    assert found.known == first
    assert found.problems == ("release 1 does not hold: expired at 2026-08-02T12:00:00Z",)
