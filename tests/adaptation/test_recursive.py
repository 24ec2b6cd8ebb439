"""Recursive least squares: estimates of friction, their bounds, and the fallback."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from plants import model, record

from pytest_twin.adaptation.recursive import Recursion, track
from pytest_twin.adaptation.update_trial import try_update
from pytest_twin.adaptation.updated_parameters import base_parameters
from pytest_twin.adaptation_spec import ShadowPolicy, UpdateSpec
from pytest_twin.errors import SpecError
from pytest_twin.open_loop import row_of
from pytest_twin.realization import load
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recording_at

SPEC = UpdateSpec(
    "one",
    {"a.viscous_friction": (0.0, 0.4), "a.coulomb_friction": (0.0, 0.2)},
    window=0.5,
    noise=0.001,
)


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    """The base model, and trials of a plant whose friction differs."""
    folder = tmp_path_factory.mktemp("plant")
    (folder / "model.xml").write_text(model())
    realization = load(folder / "model.xml")
    topics = {"state": "/joint_states", "command": "/joint_commands"}
    trials = []
    for number in range(3):
        path = record(folder / f"{number}.mcap", model(damping=0.12, dry=0.03), phase=float(number))
        trials += make_trials(recording_at(path, topics), realization.structure)
    return realization, trials


def test_the_friction_of_the_plant_is_estimated(setting) -> None:
    realization, trials = setting
    rows = [row_of(realization, trial) for trial in trials]
    recursion = Recursion(SPEC, base_parameters(SPEC, rows[0].model))
    windows = track(recursion, rows)
    assert recursion.base == pytest.approx([0.05, 0.0])
    assert recursion.value == pytest.approx([0.12, 0.03], rel=0.1)
    # The first window is predicted with the base parameters.
    assert windows[0].updated_rms == windows[0].base_rms
    late = windows[len(windows) // 2 :]
    assert np.mean([w.updated_rms for w in late]) < 0.1 * np.mean([w.base_rms for w in late])


def test_estimates_keep_the_bounds_if_the_plant_is_outside_them(setting) -> None:
    realization, trials = setting
    spec = UpdateSpec("two", {"a.viscous_friction": (0.0, 0.08)}, window=0.5, noise=0.001)
    rows = [row_of(realization, trial) for trial in trials[:1]]
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    windows = track(recursion, rows)
    assert recursion.value[0] == 0.08
    assert all(0.0 <= w.parameters[0] <= 0.08 for w in windows)


@pytest.mark.parametrize(
    ("bounds", "resting"),
    [((0.0, 0.08), [0.08]), ((0.0, 0.4), []), ((0.05, 0.4), [])],
    ids=["below the plant's value", "wide", "from the base"],
)
def test_an_estimate_that_rests_on_a_bound_is_named(setting, bounds: tuple, resting: list) -> None:
    realization, trials = setting
    spec = UpdateSpec("two", {"a.viscous_friction": bounds}, window=0.5, noise=0.001)
    found = try_update(spec, realization, trials[:1], ShadowPolicy(metrics={"position_rms": 0.05}))
    assert [one["bound"] for one in found["update"]["at_bounds"]] == resting
    assert all(one["met"] for one in found["metrics"])
    named = [note for note in found["notes"] if "a.viscous_friction stays at its bound" in note]
    assert len(named) == len(resting)


def test_a_base_outside_the_bounds_is_refused(setting) -> None:
    realization, _ = setting
    spec = UpdateSpec("three", {"a.viscous_friction": (0.1, 0.2)})
    with pytest.raises(SpecError, match=r"value lies outside the bounds .*got 0\.05"):
        base_parameters(spec, realization.model)


def test_the_torque_constant_of_the_drive_is_estimated_beside_friction(tmp_path: Path) -> None:
    """The plant's servo has 70 % of the model's effort, in its gain and in its limit."""
    base = model().replace('kp="1.0"', 'kp="1.0" forcerange="-0.6 0.6"')
    plant = model(damping=0.08).replace('kp="1.0"', 'kp="0.7" forcerange="-0.42 0.42"')
    (tmp_path / "model.xml").write_text(base)
    realization = load(tmp_path / "model.xml")
    topics = {"state": "/joint_states", "command": "/joint_commands"}
    rows = []
    for number in range(3):
        path = record(tmp_path / f"{number}.mcap", plant, phase=float(number))
        trials = make_trials(recording_at(path, topics), realization.structure)
        rows += [row_of(realization, trial) for trial in trials]
    spec = UpdateSpec(
        "drive", {"a.torque_constant": (-0.6, 0.6), "a.viscous_friction": (0.0, 0.3)}, window=0.5,
        noise=0.001,
    )  # fmt: skip
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    assert recursion.base == pytest.approx([0.0, 0.05])
    track(recursion, rows)
    assert recursion.value == pytest.approx([-0.3, 0.08], abs=0.01)
    # The base model itself is not changed.
    assert realization.model.actuator_gainprm[0, 0] == 1.0


@pytest.mark.parametrize(
    ("name", "bounds", "words"),
    [
        ("a.torque_constant", (-1.0, 0.5), "and above -1"),
        ("b.torque_constant", (-0.5, 0.5), "no such joint"),
        ("free.torque_constant", (-0.5, 0.5), "no drive with a torque constant"),
    ],
)
def test_a_torque_constant_that_no_drive_has_is_refused(
    tmp_path: Path, name: str, bounds: tuple[float, float], words: str
) -> None:
    undriven = '<body><joint name="free"/><geom size="0.1" mass="1"/></body></worldbody>'
    (tmp_path / "model.xml").write_text(model().replace("</worldbody>", undriven))
    with pytest.raises(SpecError, match=words):
        base_parameters(UpdateSpec("x", {name: bounds}), load(tmp_path / "model.xml").model)


def test_the_update_passes_the_test_of_every_fault(setting) -> None:
    realization, trials = setting
    document = try_update(SPEC, realization, trials, ShadowPolicy())
    assert {fault["fault"]: fault["holds"] for fault in document["faults"]} == dict.fromkeys(
        (
            "distribution_shift", "sensor_dropout", "stale_time", "saturation",
            "contact_transition", "restart",
        ),
        True,
    )  # fmt: skip
    assert all(one["met"] for one in document["metrics"])
    for fault in document["faults"]:
        if fault["fault"] != "restart":
            assert fault["exact_updated_rms"] < 1.1 * fault["exact_base_rms"]


def test_an_update_that_trusts_every_window_fails_the_tests_of_wrong_measurements(
    setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Least squares with the noise of the sensor alone, whatever the innovation is."""

    def trusting(self, jacobian, innovation, share):
        variance = share * self.spec.noise**2
        information = np.linalg.inv(self.covariance / self.spec.forgetting)
        self.covariance = np.linalg.inv(information + jacobian.T @ jacobian / variance)
        step = self.covariance @ (jacobian.T @ np.nan_to_num(innovation)) / variance
        self.value = np.clip(self.value + step, *self.bounds)
        return "updated"

    monkeypatch.setattr(Recursion, "update", trusting)
    realization, trials = setting
    document = try_update(SPEC, realization, trials, ShadowPolicy())
    failed = {fault["fault"]: fault["why"] for fault in document["faults"] if not fault["holds"]}
    assert set(failed) >= {"distribution_shift", "stale_time", "contact_transition"}
    assert all("exactly the base model" in why for why in failed.values())


def test_the_base_parameters_are_used_while_the_update_predicts_worse(setting) -> None:
    """As with a wrong encoder scale: the estimated parameters predict worse and are not used."""
    realization, trials = setting
    rows = [row_of(realization, trial) for trial in trials]
    recursion = Recursion(SPEC, base_parameters(SPEC, rows[0].model))
    recursion.compare(0.01, 0.02)
    assert recursion.has_fallback
    assert recursion.in_use is recursion.base
    for _ in range(20):
        recursion.compare(0.02, 0.01)
    assert not recursion.has_fallback


def test_an_update_of_a_worse_model_is_compared_with_the_released_model(
    setting, tmp_path: Path
) -> None:
    """With 20 times the damping, the update improves this model but not on the released one."""
    released, trials = setting
    (tmp_path / "model.xml").write_text(model(damping=1.0))
    worse = load(tmp_path / "model.xml")
    spec = UpdateSpec("hides", {"a.coulomb_friction": (0.0, 0.2)}, window=0.5, noise=0.001)
    policy = ShadowPolicy(metrics={"position_rms": 0.05})
    against_itself = try_update(spec, worse, trials[:1], policy)
    against_release = try_update(spec, worse, trials[:1], policy, released)
    changes = [one["metrics"][0]["change"] for one in (against_itself, against_release)]
    assert changes[1] > 1.0 > changes[0]
    assert not against_release["metrics"][0]["met"]
    assert any("compared with the release's" in note for note in against_release["notes"])
    # If the released model adapts too, the candidate compares even worse.
    adapting = try_update(spec, worse, trials[:1], policy, released, spec)
    assert adapting["metrics"][0]["change"] > changes[1]


def test_the_estimate_follows_slowly_changing_friction(tmp_path: Path) -> None:
    """Over the recordings Coulomb friction doubles and viscous friction falls by 40 %."""
    (tmp_path / "model.xml").write_text(model(damping=0.1, dry=0.02))
    realization = load(tmp_path / "model.xml")
    rows = []
    for number in range(4):
        age = number / 3.0
        plant = model(damping=0.1 * (1.0 - 0.4 * age), dry=0.02 * (1.0 + age))
        path = record(tmp_path / f"{number}.mcap", plant, phase=float(number), seconds=6.0)
        topics = {"state": "/joint_states", "command": "/joint_commands"}
        trials = make_trials(recording_at(path, topics), realization.structure)
        rows += [row_of(realization, trial) for trial in trials]
    spec = UpdateSpec(
        "wear", {"a.viscous_friction": (0.0, 0.4), "a.coulomb_friction": (0.0, 0.2)}, window=0.5,
        forgetting=0.9,
    )  # fmt: skip
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    windows = track(recursion, rows)
    late = windows[-10:]
    assert recursion.value == pytest.approx([0.06, 0.04], rel=0.15)
    assert np.mean([w.updated_rms for w in late]) < 0.4 * np.mean([w.base_rms for w in late])
