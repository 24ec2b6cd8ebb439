"""An effect from another package, ``examples/magnet``: one class and one entry point."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "diagnosis"))

from two_pendulums import MAGNET_AT, MAGNET_WIDTH, case

MAGNET = Path(__file__).parents[2] / "examples" / "magnet"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A site-packages folder in which the example package is installed."""
    points = tomllib.loads((MAGNET / "pyproject.toml").read_text())["project"]["entry-points"]
    ((group, ((name, target),)),) = [(group, one.items()) for group, one in points.items()]
    site = tmp_path / "site"
    told = site / "my_effects-1.0.dist-info"
    told.mkdir(parents=True)
    (site / "magnet.py").write_text((MAGNET / "magnet.py").read_text())
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: my-effects\nVersion: 1.0\n")
    (told / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
    monkeypatch.setenv("PYTHONPATH", str(site))
    return site


def pytest_twin(*words: str) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name("pytest-twin")), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_an_installed_effect_is_listed_by_the_effects_command(site: Path) -> None:
    done = pytest_twin("effects")
    assert done.returncode == 0, done.stderr
    assert "[`magnet`](#magnet)" in done.stdout
    assert "    u = (q - pose) / width" in done.stdout
    row = "| `strength` | strength | `N*m` or `N` | 0 | 0 to 10 times the drive's RMS effort |"
    assert row in done.stdout


@pytest.mark.nightly
def test_an_installed_effect_is_found_and_fitted_by_diagnose(site: Path, tmp_path: Path) -> None:
    words = case(tmp_path / "case", magnet=0.08)
    done = pytest_twin("diagnose", "--seconds", "0", *words, "--out", str(tmp_path / "why"))
    assert done.returncode == 0, done.stdout + done.stderr
    said = json.loads((tmp_path / "why" / "diagnosis.json").read_text())
    assert [(f["effect"], f["joint"]) for f in said["findings"]] == [("magnet", "left")]
    found = said["findings"][0]["parameters"]
    for name, truth in (("strength", 0.08), ("pose", MAGNET_AT), ("width", MAGNET_WIDTH)):
        low, high = found[name]["ci95"]
        assert low <= truth <= high
        assert found[name]["value"] == pytest.approx(truth, rel=0.05)
    replayed = pytest_twin(
        "replay", str(tmp_path / "why"), words[-1], "--out", str(tmp_path / "predicted.mcap")
    )
    assert replayed.returncode == 0, replayed.stderr


@pytest.mark.parametrize(
    ("written", "instead", "told"),
    [
        ("import numpy", "import no_such_module", "cannot be loaded: ModuleNotFoundError"),
        ('family = "environment"', 'family = "magic"', "magnet.family"),
        ('"effort", 0.0, 0.0, 10.0', '"effort", None, 0.0, 10.0', "neutral value"),
        ('id = "magnet"', 'id = "coulomb_friction"', "magnet.id"),
        ("-3.2, 3.2", "3.2, -3.2", "magnet.parameters.pose.lower"),
        ("(0.05, 0.15)", "(0.05, 5.0)", "magnet.parameters.width"),
        ('(0.3,), "effort"', '(0.3,), "joule"', "magnet.parameters.strength.reference"),
        ('(0.3,), "effort"', '(0.3,), "effort", under=("form", (1.0,))', "strength.under"),
        ('id = "magnet"', 'id = "magnet"\n    dry_friction_level = "level"', "dry_friction_level"),
        (
            'parameters = (\n        Parameter("strength", "effort", 0.0, 0.0, 10.0, (0.3,)',
            "is_limit = True\n    parameters = (\n"
            '        Parameter("strength", "effort", 0.0, 0.0, 10.0, (0.3, 0.2)',
            "magnet.parameters.strength.starts",
        ),
        ("class Magnet(Effect)", "class Magnet", "subclass of pytest_twin.effects.Effect"),
    ],
)
def test_an_invalid_effect_definition_is_reported_in_one_line(
    site: Path, written: str, instead: str, told: str
) -> None:
    module = site / "magnet.py"
    text = module.read_text()
    assert written in text
    module.write_text(text.replace(written, instead))
    done = pytest_twin("effects")
    assert done.returncode == 2
    assert told in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


def test_two_packages_may_not_define_the_same_effect(site: Path) -> None:
    told = site / "my_effects-1.0.dist-info" / "entry_points.txt"
    told.write_text("[pytest_twin.effects]\ncogging = magnet:Magnet\n")
    module = site / "magnet.py"
    module.write_text(module.read_text().replace('id = "magnet"', 'id = "cogging"'))
    done = pytest_twin("effects")
    assert done.returncode == 2
    assert "defines an effect that another package also defines" in done.stderr
