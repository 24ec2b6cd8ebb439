"""--twin-report, --twin-key and --twin-timeout, each also as an ini option."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")


def test_the_report_is_written_to_the_twins_output_folder(released) -> None:
    released.edit("golden/fk/home.yaml", "position: 0.1 mm", "position: 0.2 mm")
    path = released.root / ".twin" / "report.html"
    path.unlink()
    released.run().stdout.fnmatch_lines([f"report: {path}"])
    page = path.read_text()
    assert "golden/fk/home" in page
    assert "golden/mass/arm" in page


def test_goldens_outside_the_selection_are_reported_as_not_run(recorded) -> None:
    for selection in (("-k", "home"), ("golden/fk/home.yaml::home[mujoco]",)):
        recorded.run(*selection).assert_outcomes(passed=1, deselected="::" not in selection[0])
        page = (recorded.root / ".twin" / "report.html").read_text()
        assert "1 ran, 0 critical failed, 0 still proven, 1 not run" in page
        assert "golden/mass/arm@mujoco: stale, and not run" in page
        assert "<h2>Failed" not in page


def test_without_stale_goldens_the_signed_report_is_shown(released) -> None:
    path = released.root / "releases" / "0001" / "report.html"
    released.run().stdout.fnmatch_lines([f"report: {path}"])
    assert path.is_file()


def test_the_report_is_written_to_the_given_path(released) -> None:
    released.run("--twin-report", "out/gate.html").stdout.fnmatch_lines(
        [f"report: {released.root}/out/gate.html"]
    )
    assert (released.root / "out" / "gate.html").is_file()
    released.write("pytest.ini", "[pytest]\ntwin_report = from_ini.html\n")
    released.run()
    assert (released.root / "from_ini.html").is_file()


def test_an_untrusted_key_cannot_sign_a_release(released) -> None:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
    )

    key = Ed25519PrivateKey.generate()
    path = released.pytester.path / "foreign.pem"
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    path.chmod(0o600)
    released.edit("golden/fk/home.yaml", "position: 0.1 mm", "position: 0.2 mm")
    for how in ("flag", "ini"):
        if how == "ini":
            released.write("pytest.ini", f"[pytest]\ntwin_key = {path}\n")
        arguments = ("--twin-key", str(path)) if how == "flag" else ()
        result = released.run("--twin-release", *arguments)
        result.stdout.fnmatch_lines(["no release:", "*is not a key that this twin*"])
        assert result.ret == pytest.ExitCode.TESTS_FAILED
    assert released.releases == ["0001"]


@pytest.mark.parametrize("value", ["0", "soon", "nan", "-1"])
def test_an_invalid_timeout_is_refused(recorded, value) -> None:
    recorded.write("pytest.ini", f"[pytest]\ntwin_timeout = {value}\n")
    result = recorded.run()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --twin-timeout: *expected a number of seconds above 0"])
