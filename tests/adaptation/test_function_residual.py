"""A residual of the kind ``function``: a class of an installed package."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from plants import model, record

from pytest_twin import adaptation_spec
from pytest_twin.adaptation import laws, shadow
from pytest_twin.errors import SpecError
from pytest_twin.twin import load_twin

STIFFNESS = 0.4
"""N*m/rad of a spring that the model lacks."""
TWIN = """\
name: pendulum
model: model.xml
shadow: {metrics: {position_rms: 0.5}}
"""
RESIDUAL = """\
residual:
  id: spring-1
  kind: function
  function: spring
  hold_off: 0.05
  joints: {a: {bound: 0.6, position: [-1.5, 1.5], velocity: [-8, 8], jump: 1.5}}
"""


class Spring:
    """The missing spring."""

    def __call__(self, position, velocity, command):
        return -STIFFNESS * position, None


class TwoOutputs:
    def __call__(self, position, velocity, command):
        return [0.0, 0.0], None


class Raises:
    def __call__(self, position, velocity, command):
        raise KeyError("weights")


class Point(EntryPoint):
    """An entry point of this module with a package of its own."""

    version = "1.0"

    @property
    def dist(self):
        return SimpleNamespace(name="springs", version=self.version)


def install(monkeypatch: pytest.MonkeyPatch, *classes: str, version: str = "1.0") -> None:
    """Pretend that a package is installed whose residual ``spring`` is one of these classes."""
    kind = type("Point", (Point,), {"version": version})
    points = tuple(
        kind("spring", f"{__name__}:{name}", "pytest_twin.residuals") for name in classes
    )
    for module in (laws, adaptation_spec):
        monkeypatch.setattr(module, "entry_points_by_name", lambda group: {"spring": points})


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    (tmp_path / "model.xml").write_text(model())
    (tmp_path / "release.yaml").write_text(TWIN)
    (tmp_path / "twin.yaml").write_text(TWIN + RESIDUAL)
    return tmp_path / "twin.yaml"


def test_a_function_of_a_package_is_compared_and_passes_the_tests_of_all_faults(
    twin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, "Spring")
    data = twin.with_name("0.mcap")
    record(data, model(), force=lambda q, v: -STIFFNESS * q, phase=1.0)
    document = shadow.shadow(str(twin.with_name("release.yaml")), str(twin), [str(data)])
    change = {one["metric"]: one["change"] for one in document["metrics"]}
    assert change["position_rms"] < -0.9
    assert [fault["holds"] for fault in document["faults"]] == [True] * 6
    assert document["verdict"] == "better"


def test_another_version_of_the_package_is_another_residual(
    twin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = []
    for version in ("1.0", "1.1", "1.0"):
        install(monkeypatch, "Spring", version=version)
        digests.append(adaptation_spec.digest_of(load_twin(twin).residual, None))
    assert digests[0] == digests[2]
    assert digests[0] != digests[1]


@pytest.mark.parametrize(
    ("classes", "words"),
    [
        ((), "no installed package provides the residual 'spring'"),
        (("Spring", "Raises"), "both provide this residual"),
        (("Missing",), "package 'springs' 1.0 cannot be loaded: AttributeError"),
        (("Raises",), "package 'springs' 1.0 does not run: KeyError: 'weights'"),
        (("TwoOutputs",), "another number of outputs"),
    ],
)
def test_a_function_that_cannot_be_used_is_refused_with_its_package(
    twin: Path, classes: tuple[str, ...], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, *classes)
    with pytest.raises(SpecError) as error:
        laws.law_of(load_twin(twin).residual)
    assert words in str(error.value)


def test_the_function_gets_arrays_of_the_joints(
    twin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, "Spring")
    force, deviation = laws.law_of(load_twin(twin).residual)(*np.array([[0.5], [0.0], [0.0]]))
    assert force.tolist() == [-0.2]
    assert deviation is None
