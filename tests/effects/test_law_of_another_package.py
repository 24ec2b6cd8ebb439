"""A law that pytest-twin does not know reaches every command by its traits alone."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "identification"))
sys.path.append(str(Path(__file__).parents[1] / "adaptation"))
sys.path.append(str(Path(__file__).parents[1] / "excitation"))
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from approved_arms import approved_for_arm, write_twin
from arms import REAL, TRUE, write_model, write_recording
from fourier_motion import fourier, needed_effort
from plants import model, record
from test_further_effects import write_trial
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.adaptation.recursive import Recursion, track
from pytest_twin.adaptation.updated_parameters import base_parameters
from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.budget.categories import category_of_parameter
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.write import load_written
from pytest_twin.effects import catalogue
from pytest_twin.errors import SpecError
from pytest_twin.excitation.excite import excite
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.simulation.stage_effects import StagePlan
from pytest_twin.open_loop import row_of
from pytest_twin.ranges.gather import collect_uncertain_parameters
from pytest_twin.realization import load
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recording_at
from pytest_twin.twin import load_twin

LAW = '''
import numpy as np
from pytest_twin.effects import Effect, Parameter, RegressorColumn

class VaneDrag(Effect):
    """Drag of a vane that opens in one direction only."""

    id = "vane_drag"
    family = "friction"
    stage = "friction"
    regressor_symbol = "fw"
    law = "effort = -coefficient v^2 for v > 0, else 0"
    source = "drag equation, one-sided"
    parameters = (
        Parameter("coefficient", "drag", 0.0, 0.0, 20.0, (0.2,), "drag", meaning="vane drag"),
    )
    confused_with = {"quadratic_drag": "record both directions: a vane acts in one"}

    def force(self, world, values):
        world.drag_motor(values["coefficient"] * np.maximum(world.motor_velocity, 0.0))

    def regressor_column(self, position, velocity, acceleration):
        forward = np.maximum(velocity, 0.0)
        return RegressorColumn(forward**2, by_velocity=2.0 * forward)
'''
DRAG = 0.5
"""N*m*s^2/rad^2."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A package with the law, as pip installs it."""
    site = tmp_path_factory.mktemp("site")
    metadata = site / "vanes-1.0.dist-info"
    metadata.mkdir()
    (site / "vanes.py").write_text(LAW)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: vanes\nVersion: 1.0\n")
    points = "[pytest_twin.effects]\nvane_drag = vanes:VaneDrag\n"
    (metadata / "entry_points.txt").write_text(points)
    sys.path.insert(0, str(site))
    importlib.invalidate_caches()
    catalogue.cache_clear()
    yield
    sys.path.remove(str(site))
    sys.modules.pop("vanes", None)
    catalogue.cache_clear()


@pytest.fixture(scope="module")
def identified(installed: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an identification of an arm with a vane at its elbow, from measured effort."""
    folder = tmp_path_factory.mktemp("vane")
    plant = mujoco.MjModel.from_xml_string(TRUE.format(**REAL))
    paths = []
    for seed in (1, 2, 3):
        random = np.random.default_rng(seed)
        time = np.arange(2000) / 100.0
        q, v, a = fourier(random, time, 2, 5, 0.1, (0.1, 0.6))
        effort = needed_effort(plant, q, v, a) + 0.02 * random.standard_normal(q.shape)
        effort[:, 1] += DRAG * np.maximum(v[:, 1], 0.0) ** 2
        paths.append(str(write_recording(folder / f"{seed}.csv", time, q, effort)))
    (folder / "out").mkdir()
    document = identify_files({
        "model": str(write_model(folder)), "recordings": paths[:2], "held_out": paths[2:],
        "out": str(folder / "out"), "name": "out",
    })  # fmt: skip
    (folder / "out/identification.json").write_text(json.dumps(document))
    return folder


def document_of(identified: Path) -> dict[str, Any]:
    return json.loads((identified / "out/identification.json").read_text())


def test_measured_effort_identifies_the_law_and_the_written_model_has_it(identified: Path) -> None:
    document = document_of(identified)
    assert document["verdict"] == "accepted"
    found = document["parameters"]["elbow.vane_drag"]
    low, high = found["ci95"]
    assert low <= DRAG <= high
    assert found["value"] == pytest.approx(DRAG, rel=0.05)
    assert (found["unit"], found["stage"]) == ("N*m*s^2/rad^2", "friction")
    assert document["held_out"]["elbow"]["effort_relative"] < 0.05
    patched = read_patched_model(load_written(identified / "out/realization"))
    assert patched is not None
    (written,) = (one for one in patched.effects if one.joint == "elbow" and not one.is_in_mjcf)
    assert written.effect == "vane_drag"
    assert written.values["coefficient"] == pytest.approx(DRAG, rel=0.05)


def test_randomize_samples_the_law(identified: Path) -> None:
    (identified / "twin.yaml").write_text(
        "model: out/realization\nfit:\n  - {file: out/identification.json}\n"
    )
    twin = load_twin(identified / "twin.yaml")
    first = twin.first_realization
    realization = load(first.file, twin=twin, name=first.name)
    patched = read_patched_model(realization)
    found = collect_uncertain_parameters(twin, realization, patched)
    (vane,) = (c for c in found.distribution.coordinates if c.name == "elbow.vane_drag")
    assert (vane.effect, vane.parameter, vane.lower) == ("vane_drag", "coefficient", 0.0)
    assert vane.std > 0.0


def test_budget_has_a_category_for_the_law(installed: None) -> None:
    assert category_of_parameter("elbow.vane_drag") == "friction_and_transmission"


def test_excite_predicts_how_well_the_law_is_determined(installed: None, tmp_path: Path) -> None:
    path = write_twin(tmp_path, approved_for_arm(mechanisms=["friction"]))
    twin = load_twin(path)
    found = excite(load(twin.first_realization.file, twin=twin), twin)
    predicted = {one.name: one for one in found.predicted}
    assert np.isfinite(predicted["elbow.vane_drag"].std)
    assert predicted["elbow.vane_drag"].unit == "N*m*s^2/rad^2"


def test_identification_by_simulation_finds_the_law(installed: None, tmp_path: Path) -> None:
    """From commands and positions alone; the written model has the law."""
    assert StagePlan.after_effort(frozenset()).stage_of["vane_drag"] == "closed_loop"
    drag = 0.3
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    *fit, held = (
        str(write_trial(
            tmp_path / f"{seed}.csv", seed,
            lambda effort, velocity: effort - drag * max(velocity, 0.0) ** 2,
        ))
        for seed in (1, 2, 3)
    )  # fmt: skip
    (tmp_path / "out").mkdir()
    document = identify_files({
        "model": str(tmp_path / "model.xml"), "recordings": fit, "held_out": [held],
        "out": str(tmp_path / "out"), "name": "out", "options": {"command_between": "held"},
    })  # fmt: skip
    found = document["parameters"]["swing.vane_drag"]
    assert found["value"] == pytest.approx(drag, rel=0.05)
    assert found["ci95"][0] <= drag <= found["ci95"][1]
    assert found["stage"] == "friction"
    patched = read_patched_model(load_written(tmp_path / "out/realization"))
    assert patched is not None
    assert [one.effect for one in patched.effects if not one.is_in_mjcf] == ["vane_drag"]


def test_adaptation_updates_the_law(installed: None, tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(model())
    base = load(tmp_path / "model.xml")
    topics = {"state": "/joint_states", "command": "/joint_commands"}
    path = record(tmp_path / "vane.mcap", model(), force=lambda q, v: -0.02 * max(v, 0.0) ** 2)
    trials = make_trials(recording_at(path, topics), base.structure)
    spec = UpdateSpec("one", {"a.vane_drag.coefficient": (0.0, 0.1)}, window=0.5, noise=0.001)
    rows = [row_of(base, trial) for trial in trials]
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    track(recursion, rows, base=base)
    assert recursion.base == pytest.approx([0.0])
    assert recursion.value == pytest.approx([0.02], rel=0.1)


@pytest.mark.parametrize(
    ("written", "instead", "named"),
    [
        ('stage = "friction"', 'stage = "rolling"', "vane_drag.stage"),
        ('regressor_symbol = "fw"', "", "vane_drag.regressor_symbol"),
        ('stage = "friction"', 'mjcf_field = "mass"', "vane_drag.mjcf_field"),
        ('stage = "friction"', 'mjcf_field = "damping"', "two effects are added to one field"),
        ('stage = "friction"', 'basic_modes = ("torque",)', "vane_drag.basic_modes"),
    ],
)
def test_a_wrong_trait_is_refused_in_one_line(
    installed: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    written: str,
    instead: str,
    named: str,
) -> None:
    assert written in LAW
    (tmp_path / "vanes.py").write_text(LAW.replace(written, instead))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "vanes", raising=False)
    catalogue.cache_clear()
    with pytest.raises(SpecError) as refused:
        catalogue()
    monkeypatch.undo()
    sys.modules.pop("vanes", None)
    catalogue.cache_clear()
    assert named in str(refused.value)


def test_an_update_of_an_unknown_parameter_is_refused_with_those_of_the_law(
    installed: None,
) -> None:
    plant = mujoco.MjModel.from_xml_string(model())
    spec = UpdateSpec("one", {"a.vane_drag.width": (0.0, 0.1)})
    with pytest.raises(SpecError, match="no such parameter") as refused:
        base_parameters(spec, plant)
    assert "coefficient" in str(refused.value)
