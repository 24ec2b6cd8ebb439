"""Effects are chosen without the test recordings, which are opened once, at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from two_pendulums import JOINTS, mjcf, record

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.roles import Roles, roles_of
from pytest_twin.diagnosis.trials import TrialSet, read_trials

LEFT = JOINTS[:1]


def read(folder: Path, fit: list[Path], held_out: list[Path]) -> TrialSet:
    loaded = load_model(folder / "model.xml")
    return read_trials(fit, held_out, loaded.topics, loaded.realization.structure)


def put(folder: Path, name: str, seed: int, seconds: float = 2.2, **told: str) -> Path:
    (folder / "model.xml").write_text(mjcf(LEFT))
    return record(folder / name, seed, joints=LEFT, seconds=seconds, told=told, viscous=0.1)


def validated(roles: Roles) -> set[str]:
    return {t.path.name for t in roles.validation}


@pytest.mark.parametrize("count", [2, 5], ids=["none validates", "one validates"])
def test_a_search_without_the_test_recordings_on_disk_finds_the_same(
    tmp_path: Path, count: int
) -> None:
    """The held-out recording has more friction and moves further: a search that saw it would
    differ.
    """
    fit = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(count)]
    test = record(tmp_path / "test.mcap", 9, joints=LEFT, seconds=3.0, viscous=0.14, noise=3e-4)
    realization = load_model(tmp_path / "model.xml").realization

    def diagnosed() -> Diagnosis:
        return diagnose(realization, read(tmp_path, fit, [test]), threads=1)

    opened = diagnosed()
    test.unlink()
    absent = diagnosed()
    assert opened.has_held_out
    assert not absent.has_held_out
    assert len(opened.roles.validation) == (1 if count == 5 else 0)
    assert [(f.effect, f.joint) for f in absent.explained.findings] == [
        ("viscous_friction", "left")
    ]
    for one, other in zip(opened.explained.findings, absent.explained.findings, strict=True):
        assert (one.effect, one.joint) == (other.effect, other.joint)
        assert one.parameters == other.parameters
    np.testing.assert_array_equal(
        opened.explained.hypothesis.theta, absent.explained.hypothesis.theta
    )
    (gain,) = (f.held_out_gain for f in opened.explained.findings)
    assert gain < 0.97, "of the recording with more friction than was fitted"


def test_parameters_are_fitted_to_fit_and_validation_recordings(tmp_path: Path) -> None:
    fit = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(4)]
    test = put(tmp_path, "test.mcap", 9)
    realization = load_model(tmp_path / "model.xml").realization
    found = diagnose(realization, read(tmp_path, fit, [test]), threads=1)
    assert len(found.roles.validation) == 1
    trials = found.to_json(realization="realization/")["trials"]
    assert sorted(trials["fit"] + trials["validation"]) == [p.name for p in fit]
    assert trials["held_out"] == ["test.mcap"]
    assert len(found.prepared.problem.fit) == 4
    assert not len(found.prepared.problem.held_out)


def test_a_finding_that_the_held_out_recordings_contradict_is_doubted(tmp_path: Path) -> None:
    """Friction was higher than the model's while what is fitted was recorded, and lower later."""
    fit = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(2)]
    test = record(tmp_path / "test.mcap", 9, joints=LEFT, viscous=-0.02)
    realization = load_model(tmp_path / "model.xml").realization
    found = diagnose(realization, read(tmp_path, fit, [test]), threads=1)
    (finding,) = found.explained.findings
    assert finding.held_out_gain < 0.0
    assert finding.confidence <= 0.5
    said = (
        "viscous_friction at left: it improves the fitted recordings and makes the held-out error"
    )
    assert any(note.startswith(said) for note in found.notes)


def test_a_fifth_to_a_third_of_the_time_validates_whatever_the_order(tmp_path: Path) -> None:
    files = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(8)]
    roles = roles_of(read(tmp_path, files, files[7:]))
    seconds = [sum(t.duration for t in each) for each in (roles.fit, roles.validation)]
    assert 0.2 <= seconds[1] / sum(seconds) <= 1.0 / 3.0
    backwards = roles_of(read(tmp_path, files[::-1], files[7:]))
    assert validated(backwards) == validated(roles)
    assert {t.path.name for t in roles.test} == {"7.mcap"}
    assert roles.of_search.held_out == roles.validation


def test_every_controller_keeps_a_recording_to_fit(tmp_path: Path) -> None:
    kinds = ["soft"] * 4 + ["stiff"] * 3
    files = [
        put(tmp_path, f"{seed}.mcap", seed, controller=kind) for seed, kind in enumerate(kinds)
    ]
    test = put(tmp_path, "test.mcap", 9, controller="stiff")
    roles = roles_of(read(tmp_path, files, [test]))
    assert {t.metadata["controller"] for t in roles.fit} == {"soft", "stiff"}
    assert {t.metadata["controller"] for t in roles.validation} == {"soft", "stiff"}

    # What shows under a controller of one recording alone could not be validated.
    odd = put(tmp_path, "odd.mcap", 8, controller="odd")
    roles = roles_of(read(tmp_path, [*files, odd], [test]))
    assert not roles.validation
    assert "too few to validate under every controller" in roles.note


def test_the_recording_that_moves_furthest_is_fitted(tmp_path: Path) -> None:
    files = [put(tmp_path, f"{seed}.mcap", 1, seconds=1.0 + 0.2 * seed) for seed in range(5)]
    roles = roles_of(read(tmp_path, files, files[:1]))
    reach = {t.path.name: float(np.ptp(t.position)) for t in (*roles.fit, *roles.validation)}
    assert max(reach, key=lambda name: reach[name]) not in validated(roles)


def test_of_few_recordings_none_validates_and_a_note_says_so(tmp_path: Path) -> None:
    files = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(3)]
    test = put(tmp_path, "test.mcap", 9)
    roles = roles_of(read(tmp_path, files, [test]))
    assert not roles.validation
    assert len(roles.fit) == 3
    assert roles.note.startswith("3 recordings to fit, too few to set one aside for validation")


def test_what_is_held_out_has_no_influence_on_how_the_others_are_read(tmp_path: Path) -> None:
    """It has another joint than they do, and is left out itself."""
    files = [put(tmp_path, f"{seed}.mcap", seed) for seed in range(2)]
    (tmp_path / "model.xml").write_text(mjcf())
    both = [record(tmp_path / f"both{seed}.mcap", seed) for seed in range(2)]
    fit = [trial.joints for trial in read(tmp_path, both, files).fit]
    assert fit == [JOINTS, JOINTS]


def test_a_joint_that_held_out_recordings_lack_is_diagnosed_and_not_tested(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(mjcf())
    both = [record(tmp_path / f"both{seed}.mcap", seed, viscous=0.1, joint=1) for seed in range(2)]
    one = record(tmp_path / "one.mcap", 5, joints=LEFT)
    realization = load_model(tmp_path / "model.xml").realization
    found = diagnose(realization, read(tmp_path, both, [one]), threads=1)
    assert [(f.effect, f.joint) for f in found.explained.findings] == [
        ("viscous_friction", "right")
    ]
    assert set(found.errors) == {"left"}
    assert "joint 'right' is not tested: one.mcap lacks it" in found.notes
