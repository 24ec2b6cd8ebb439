"""The cache of model features is valid only while all source files and versions are unchanged."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pytest_twin.errors import ModelError
from pytest_twin.realization import load
from pytest_twin.realization.features.cache import FOLDER, Features, features_of, reader_files
from pytest_twin.twin import load_twin

MODEL = """
<mujoco>
  <include file="part.xml"/>
  <worldbody><body name="a"><joint name="j"/><geom type="mesh" mesh="m"/></body></worldbody>
</mujoco>
"""
PART = """<mujocoinclude><asset><mesh name="m"
  vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset></mujocoinclude>"""
VERSIONS = {"mujoco": "4.0.0"}


class Reader:
    """Reads a twin's model and counts the calls."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.count = 0

    def __call__(self) -> object:
        self.count += 1
        twin = load_twin(self.root / "twin.yaml")
        found = load(twin.realizations["mujoco"].file, twin=twin)
        features = Features(found.parts, found.structure, found.source.files)
        return json.loads(json.dumps(features.to_json()))

    def features(self, versions: dict[str, str] = VERSIONS, *, fresh: bool = False) -> Features:
        twin = load_twin(self.root / "twin.yaml")
        return features_of(twin, twin.first_realization, self, versions, fresh=fresh)


@pytest.fixture
def reader(tmp_path: Path) -> Reader:
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "part.xml").write_text(PART)
    (tmp_path / "twin.yaml").write_text("model: model.xml\nfit: {file: fit.yaml}\n")
    (tmp_path / "fit.yaml").write_text("id: f\n")
    return Reader(tmp_path)


def test_unchanged_files_are_read_once(reader: Reader) -> None:
    first, second = reader.features(), reader.features()
    assert reader.count == 1
    assert first == second
    assert {path.name for path in first.files} == {"model.xml", "part.xml"}


@pytest.mark.parametrize("name", ["model.xml", "part.xml", "twin.yaml", "fit.yaml"])
def test_a_changed_source_file_is_read_again(reader: Reader, name: str) -> None:
    reader.features()
    path = reader.root / name
    path.write_text(path.read_text() + "\n")
    reader.features()
    assert reader.count == 2


def test_a_changed_version_or_a_release_reads_the_model_again(reader: Reader) -> None:
    reader.features()
    reader.features({"mujoco": "4.0.1"})
    reader.features({"mujoco": "4.0.1"}, fresh=True)
    assert reader.count == 3


def test_the_cache_depends_on_all_code_that_reads_a_model() -> None:
    """In a process of its own: this one has loaded more, and may have unloaded the reader."""
    script = (
        "import sys\n"
        "import pytest_twin.realization.features.reading\n"
        "prefixes = ('pytest_twin.realization', 'pytest_twin.dependency')\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith(prefixes)), sep='\\n')"
    )
    result = subprocess.run(
        [sys.executable, "-P", "-c", script],
        check=True,
        timeout=300,
        capture_output=True,
        text=True,
    )
    files = set(map(Path, result.stdout.split("\n")[:-1]))
    assert {"reading.py", "dependency.py"} <= {path.name for path in files}
    assert files <= set(reader_files())


def forged(text: str) -> str:
    """A cache entry that was edited without updating its checksum."""
    envelope = json.loads(text)
    return json.dumps({**envelope, "entry": envelope["entry"].replace("mass", "mess")})


DAMAGE: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "cut short": lambda text: text[: len(text) // 2],
    "another byte": lambda text: text.replace("position", "pasition", 1),
    "checksum of another entry": forged,
    "a list": lambda text: "[]",
    "deeply nested": lambda text: "[" * 100_000,
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_cache_entry_is_ignored(reader: Reader, damage: Callable[[str], str]) -> None:
    first = reader.features()
    path = reader.root / FOLDER / "mujoco.json"
    path.write_text(damage(path.read_text()))
    assert reader.features() == first
    assert reader.count == 2


def test_the_cache_is_not_written_through_a_symbolic_link(reader: Reader, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (reader.root / ".twin").symlink_to(elsewhere)
    reader.features()
    assert not list(elsewhere.rglob("*.json"))


def test_a_model_that_cannot_be_read_is_not_cached(reader: Reader) -> None:
    (reader.root / "part.xml").write_text(PART.replace("0 0 1", "0 0 nan"))
    with pytest.raises(ModelError):
        reader.features()
    assert not (reader.root / FOLDER / "mujoco.json").exists()


def test_reading_the_cache_imports_no_simulator(reader: Reader) -> None:
    reader.features()
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from pytest_twin.realization.features.cache import features_of\n"
        "from pytest_twin.twin import load_twin\n"
        "def read(): raise SystemExit('read')\n"
        f"twin = load_twin(Path({str(reader.root / 'twin.yaml')!r}))\n"
        "assert features_of(twin, twin.first_realization, read, {'mujoco': '4.0.0'}).parts\n"
        "assert not {'mujoco', 'pinocchio', 'coal', 'numpy'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
