"""Diagnosis of contact: an arm touches a table whose contact parameters differ from the model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from touching_arm import FRICTION, SOLREF, case, mjcf

from pytest_twin import cli
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.locate import locate_error, smooth_motions
from pytest_twin.diagnosis.patched.native_contact import write_contact
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.effects.contact_geoms import CONTACT_DISTANCE, find_contact_geoms
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial, make_trial

pytestmark = pytest.mark.usefixtures("commands_in_process")

ONE, TWO = ("shoulder",), ("shoulder", "elbow")
CONTACT = {"contact_offset", "contact_stiffness", "contact_damping", "contact_friction"}


@pytest.mark.parametrize(
    ("effect", "parameter", "value", "unit", "joints", "hidden"),
    [
        ("contact_offset", "offset", 0.006, "m", ONE, {"offset": 0.006}),
        pytest.param(
            "contact_stiffness", "relative_error", 0.6, "1", ONE,
            {"solref": (SOLREF[0], SOLREF[1] * 1.6**-0.5)}, marks=pytest.mark.nightly,
        ),
        ("contact_damping", "relative_error", 0.6, "1", ONE,
         {"solref": (SOLREF[0] / 1.6, SOLREF[1] * 1.6)}),
        ("contact_friction", "coefficient", -0.2, "1", TWO, {"friction": FRICTION - 0.2}),
    ],
    ids=["offset", "stiffness", "damping", "friction"],
)  # fmt: skip
def test_an_error_of_a_contact_parameter_is_found_with_its_value(
    tmp_path: Path,
    effect: str,
    parameter: str,
    value: float,
    unit: str,
    joints: tuple[str, ...],
    hidden: dict[str, Any],
) -> None:
    words = case(tmp_path, joints, seconds=1.4, **hidden)
    assert cli.main(["diagnose", "--seconds", "0", *words, "--out", str(tmp_path / "out")]) == 0
    diagnosis = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "explained"
    (finding,) = diagnosis["findings"]
    assert (finding["effect"], finding["joint"]) == (effect, None)
    estimate = finding["parameters"][parameter]
    low, high = estimate["ci95"]
    assert estimate["unit"] == unit
    assert low <= value <= high
    assert high - low < 0.5 * abs(value)
    assert finding["held_out_gain"] > 0.9
    (kept,) = json.loads((tmp_path / "out" / "realization" / "effects.json").read_text())["effects"]
    assert (kept["effect"], kept["in_model"]) == (effect, True)
    assert "'table'" in kept["written"]


def test_viscous_friction_and_contact_stiffness_are_found_together(
    tmp_path: Path,
) -> None:
    words = case(tmp_path, ONE, seconds=1.4, solref=(SOLREF[0], SOLREF[1] * 1.6**-0.5), damping=0.2)
    assert cli.main(["diagnose", "--seconds", "0", *words, "--out", str(tmp_path / "out")]) == 0
    diagnosis = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "explained"
    found = {f["effect"]: f["parameters"] for f in diagnosis["findings"]}
    assert found.keys() == {"contact_stiffness", "viscous_friction"}
    for estimate, hidden in (
        (found["contact_stiffness"]["relative_error"], 0.6),
        (found["viscous_friction"]["coefficient"], 0.1),
    ):
        assert estimate["ci95"][0] <= hidden <= estimate["ci95"][1]
        assert estimate["value"] == pytest.approx(hidden, rel=0.1)


def test_windows_without_contact_are_away_from_the_table(tmp_path: Path) -> None:
    words = case(tmp_path, ONE)
    realization = load_model(tmp_path / "model.xml").realization
    trials = [make_trial(read_recording(Path(w)), realization.structure) for w in words[1:]]
    contact = prepare(realization, trials, []).problem.simulator.models.contact
    assert contact.world.size
    air = prepare(realization, trials, [], window=0.2, contact=contact)
    segments = air.problem.simulator.segments
    assert all(s.starts_in_motion for s in segments)
    far = [0.2 - 0.02 - 0.3 * np.sin(t.position[:, 0]) > CONTACT_DISTANCE for t in trials]
    for trial, clear in zip(trials, far, strict=True):
        mine = [s for s in segments if trials[s.trial] is trial]
        kept = {float(t) for s in mine for t in s.time}
        # Of the samples without contact, only those in windows that are too short are lost.
        assert kept <= set(trial.time[clear])
        assert len(kept) > 0.8 * clear.sum()
    assert 0.1 < np.concatenate(far).mean() < 0.9
    # Away from the table, contact effects are no candidates, and motions are linearized.
    assert not air.problem.simulator.models.contact.world.size
    assert not {t.effect for t in candidates(air.problem)} & CONTACT


def test_an_arm_that_is_always_in_contact_has_no_windows_without_contact(
    bench: tuple[Path, Trial, PreparedProblem],
) -> None:
    folder, trial, prepared = bench
    contact = prepared.problem.simulator.models.contact
    low = replace(trial, position=np.tile([0.3, 0.6], (len(trial.time), 1)))
    realization = load_model(folder / "model.xml").realization
    with pytest.raises(RecordingError, match=r"all the time.*0\.05 m"):
        prepare(realization, [low], [], window=0.2, contact=contact)


def test_contact_effects_are_candidates_only_if_there_is_contact(tmp_path: Path) -> None:
    for height, expected in ((0.0, CONTACT), (-2.0, set())):
        folder = tmp_path / str(height)
        folder.mkdir()
        words = case(folder, ONE, seconds=0.5, offset=height)
        (folder / "model.xml").write_text(mjcf(ONE, offset=height))
        realization = load_model(folder / "model.xml").realization
        trials = [make_trial(read_recording(Path(w)), realization.structure) for w in words[1:]]
        terms = candidates(prepare(realization, trials, []).problem)
        assert {t.effect for t in terms} & CONTACT == expected


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trial, PreparedProblem]:
    folder = tmp_path_factory.mktemp("bench")
    words = case(folder, TWO, seconds=1.5)
    realization = load_model(folder / "model.xml").realization
    trial = make_trial(read_recording(Path(words[1])), realization.structure)
    return folder, trial, prepare(realization, [trial], [])


@pytest.mark.parametrize(
    ("values", "written"),
    [
        ({"contact_offset": {"offset": 0.01}}, ("geom 'table' pos",)),
        ({"contact_offset": {"offset": -0.01}}, ("geom 'table' pos",)),
        ({"contact_stiffness": {"relative_error": 0.8}}, ("geoms 'table', 'elbow_geom' solref",)),
        ({"contact_damping": {"relative_error": -0.5}}, ("geoms 'table', 'elbow_geom' solref",)),
        ({"contact_friction": {"coefficient": 0.2}}, ("geoms 'table', 'elbow_geom' friction",)),
        (
            {
                "contact_offset": {"offset": 0.004},
                "contact_stiffness": {"relative_error": 0.8},
                "contact_damping": {"relative_error": 0.5},
            },
            ("geom 'table' pos", *["geoms 'table', 'elbow_geom' solref"] * 2),
        ),
    ],
    ids=[
        "offset up",
        "offset down",
        "stiffness",
        "damping",
        "friction",
        "offset, stiffness and damping",
    ],
)
def test_the_written_model_predicts_the_same_motion_as_the_contact_effect(
    bench: tuple[Path, Trial, PreparedProblem],
    tmp_path: Path,
    values: dict[str, dict[str, float]],
    written: tuple[str, ...],
) -> None:
    folder, trial, prepared = bench
    problem = prepared.problem
    terms = tuple(Term(effect, -1) for effect in values)
    theta = [
        values[t.effect][p.name] / problem.scales.value(p, -1) for t in terms for p in t.parameters
    ]
    found = Hypothesis(terms, np.array(theta))
    (nominal,) = problem.predict([EMPTY], np.array([0]))
    problem = problem.at(found)
    (expected,) = problem.predict([found], np.array([0]))
    out = tmp_path / "realization"
    out.mkdir()
    patched = write_realization(out, load_model(folder / "model.xml").realization, problem, found)
    assert tuple(e.written for e in patched.effects) == written
    assert patched.outside_mjcf == ()
    loaded = load_model(find_model(tmp_path))
    assert loaded.patched is not None
    (replayed,) = replay_patched(loaded.realization, loaded.patched, [trial])
    moved = np.abs(expected[0].position - nominal[0].position).max()
    assert moved > 1e-3, "the effect must change the motion, or every model would pass"
    # MJCF has six digits, and impacts amplify rounding errors.
    assert np.abs(replayed.position - expected[0].position).max() < 0.02 * moved


def test_the_regime_of_an_error_states_whether_there_is_contact(
    bench: tuple[Path, Trial, PreparedProblem],
) -> None:
    _, trial, prepared = bench
    (motion,) = smooth_motions(prepared, [trial])
    assert motion.touching is not None
    shoulder, elbow = trial.position.T
    height = 0.2 - 0.02 - 0.3 * np.sin(shoulder) - 0.3 * np.sin(shoulder + elbow)
    clear = np.abs(height - 0.01) > 1e-3
    assert 0.1 < np.mean(height < 0.01) < 0.9
    assert (motion.touching == (height < 0.01))[clear].all()
    words = {True: "in contact or within 10 mm of a surface", False: "without contact"}
    rare = bool(motion.touching.mean() < 0.5)
    found = locate_error([motion], np.where(motion.touching == rare, 1.0, 0.01), 1, "rad").summary
    assert found.startswith(words[rare])


FRAMED = """\
<mujoco><worldbody>
<frame pos=".1 0 0" euler="0 90 0"><frame euler="30 0 0">
<body name="stand" pos="0 .1 .2" euler="20 -90 10"><frame euler="0 0 40">
<geom {} friction=".6"/></frame></body></frame></frame>
<body pos="0 0 .3"><joint name="j" axis="0 1 0"/>
<geom name="tip" type="capsule" fromto="0 0 0 .4 0 0" size=".02"/></body>
</worldbody>{}</mujoco>
"""


@pytest.mark.parametrize(
    "geom",
    [
        'type="plane" size="1 1 .1"',
        'name="bar" type="box" size=".3 .3 .05" pos=".3 0 -.05"',
        'name="bar" type="capsule" size=".1" fromto=".1 -.4 .2 .1 .4 .2"',
    ],
    ids=["plane", "box", "capsule"],
)
def test_a_contact_offset_is_written_for_geoms_in_frames_or_with_end_points(geom: str) -> None:
    spec = mujoco.MjSpec.from_string(FRAMED.format(geom, ""))
    before = spec.compile()
    poses = np.linspace(-1.5, 1.5, 200)[:, None]
    contact = find_contact_geoms(before, np.array([before.joint("j").id]), [poses])
    assert len(contact.world) == 1
    name = "'bar'" if "name" in geom else "number 0"
    assert write_contact(spec, contact, "contact_offset", {"offset": 0.03}) == f"geom {name} pos"
    after = mujoco.MjModel.from_xml_string(spec.to_xml())
    data, moved = mujoco.MjData(before), mujoco.MjData(after)
    mujoco.mj_forward(before, data)
    mujoco.mj_forward(after, moved)
    normal = data.body("stand").xmat.reshape(3, 3) @ contact.normal[0]
    assert moved.geom_xpos[0] - data.geom_xpos[0] == pytest.approx(0.03 * normal, abs=1e-5)
    assert moved.geom_xmat[0] == pytest.approx(data.geom_xmat[0], abs=1e-5)
    assert after.geom_size[0] == pytest.approx(before.geom_size[0], abs=1e-5)


def test_contact_parameters_are_written_for_pairs_and_their_geoms() -> None:
    pair = '<contact><pair geom1="floor" geom2="tip" solref=".03 1" friction=".5"/></contact>'
    spec = mujoco.MjSpec.from_string(FRAMED.format('name="floor" type="plane" size="1 1 .1"', pair))
    model = spec.compile()
    contact = find_contact_geoms(model, np.array([0]), [np.linspace(-1.5, 1.5, 100)[:, None]])
    written = write_contact(spec, contact, "contact_stiffness", {"relative_error": 3.0})
    assert written == "geoms 'floor', 'tip' solref and pair number 0 solref"
    write_contact(spec, contact, "contact_friction", {"coefficient": -0.2})
    after = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert after.pair_solref[0] == pytest.approx((0.03, 0.5))
    assert after.pair_friction[0, :2] == pytest.approx((0.3, model.pair_friction[0, 1] - 0.2))
    assert after.geom_friction[:, 0] == pytest.approx((0.4, 0.8))
