"""Effects are selected without the test recordings, which are used once, at the end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import DECLARED, JOINTS, mjcf, record

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.findings import Explanation, with_unexplained_share
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.loaded_model import load_model

LEFT = JOINTS[:1]


def read(folder: Path, fit: list[Path], held_out: list[Path]) -> TrialSet:
    loaded = load_model(folder / "model.xml")
    return read_trials(fit, held_out, loaded.topics, loaded.realization.structure)


def record_pendulum(
    folder: Path, name: str, seed: int, seconds: float = 1.0, **metadata: str
) -> Path:
    (folder / "model.xml").write_text(mjcf(LEFT))
    return record(
        folder / name, seed, joints=LEFT, seconds=seconds, metadata=DECLARED | metadata, viscous=0.1
    )


@dataclass(frozen=True)
class Recorded:
    """Recordings to fit, and a test recording with more friction and a larger motion, so that a
    search that used it would have another result.
    """

    fit: list[Path]
    test: Path

    @classmethod
    def in_folder(cls, folder: Path, count: int) -> Recorded:
        fit = [record_pendulum(folder, f"{seed}.mcap", seed) for seed in range(count)]
        test = record(folder / "test.mcap", 9, joints=LEFT, seconds=2.0, viscous=0.14, noise=3e-4)
        return cls(fit, test)

    def diagnosed(self) -> Diagnosis:
        folder = self.test.parent
        realization = load_model(folder / "model.xml").realization
        return diagnose(realization, read(folder, self.fit, [self.test]), threads=1)


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recorded, Diagnosis]:
    """Four recordings to fit, and their diagnosis with the test recording on disk."""
    recorded = Recorded.in_folder(tmp_path_factory.mktemp("four"), 4)
    return recorded, recorded.diagnosed()


def assert_test_recording_was_not_used(opened: Diagnosis, absent: Diagnosis) -> None:
    assert len(opened.tested.prepared.problem.held_out) == 1
    assert len(absent.tested.prepared.problem.held_out) == 0
    assert [(f.effect, f.joint) for f in absent.explanation.findings] == [
        ("viscous_friction", "left")
    ]
    for one, other in zip(opened.explanation.findings, absent.explanation.findings, strict=True):
        assert (one.effect, one.joint) == (other.effect, other.joint)
        assert one.parameters == other.parameters
    np.testing.assert_array_equal(
        opened.explanation.hypothesis.theta, absent.explanation.hypothesis.theta
    )
    (gain,) = (f.held_out_gain for f in opened.explanation.findings)
    assert gain < 0.97, "the gain must be that of the test recording, which has more friction"


def test_a_search_without_the_test_recordings_on_disk_has_the_same_findings(
    four: tuple[Recorded, Diagnosis],
) -> None:
    recorded, opened = four
    recorded.test.unlink()
    assert_test_recording_was_not_used(opened, recorded.diagnosed())


def test_parameters_are_fitted_to_all_recordings_that_are_not_held_out(
    four: tuple[Recorded, Diagnosis],
) -> None:
    recorded, found = four
    trials = found.to_json(realization="realization/")["trials"]
    assert trials["fit"] == [p.name for p in recorded.fit]
    assert trials["held_out"] == ["test.mcap"]
    assert len(found.prepared.problem.fit) == 4
    assert not len(found.prepared.problem.held_out)


def test_a_finding_that_the_held_out_recordings_contradict_has_at_most_half_confidence(
    tmp_path: Path,
) -> None:
    """Friction was above the model's value in the fitted recordings and below it later."""
    fit = [record_pendulum(tmp_path, f"{seed}.mcap", seed) for seed in range(2)]
    test = record(tmp_path / "test.mcap", 9, joints=LEFT, seconds=1.2, viscous=-0.02)
    realization = load_model(tmp_path / "model.xml").realization
    found = diagnose(realization, read(tmp_path, fit, [test]), threads=1)
    (finding,) = found.explanation.findings
    assert finding.held_out_gain < 0.0
    assert finding.confidence <= 0.5
    expected = (
        "viscous_friction at left: it improves the fitted recordings and makes the held-out error"
    )
    assert any(note.startswith(expected) for note in found.notes)


def test_the_unexplained_share_of_the_error_at_a_joint_is_taken_from_the_confidence(
    four: tuple[Recorded, Diagnosis],
) -> None:
    """Something outside the catalogue acts at the joint, and the finding may imitate it."""
    explanation = four[1].explanation
    (finding,) = explanation.findings
    sure = replace(explanation, findings=(replace(finding, confidence=1.0),))
    of_robot = replace(explanation, findings=(replace(finding, confidence=1.0, joint=None),))
    noise, residual = (JointError(1.0, after, 0.01, "rad") for after in (0.01, 0.5))

    def confidence(of: Explanation, **errors: JointError) -> float:
        (found,) = with_unexplained_share(of, errors).findings
        return found.confidence

    assert confidence(sure, left=noise, right=residual) == 1.0
    # Half the error remains: of the way to the floor, a factor of 100, a factor of 2 is done.
    explained = np.log(2.0) / np.log(100.0)
    assert confidence(sure, left=residual, right=noise) == pytest.approx(explained)
    assert confidence(of_robot, left=noise, right=residual) == pytest.approx(explained)
    assert confidence(of_robot, left=noise, right=noise) == 1.0


def test_held_out_recordings_do_not_change_how_the_others_are_read(tmp_path: Path) -> None:
    """The held-out recordings lack a joint of the others."""
    files = [record_pendulum(tmp_path, f"{seed}.mcap", seed) for seed in range(2)]
    (tmp_path / "model.xml").write_text(mjcf())
    both = [record(tmp_path / f"both{seed}.mcap", seed, seconds=1.2) for seed in range(2)]
    fit = [trial.joints for trial in read(tmp_path, both, files).fit]
    assert fit == [JOINTS, JOINTS]


def test_a_joint_that_held_out_recordings_lack_is_diagnosed_and_not_tested(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(mjcf())
    both = [
        record(tmp_path / f"both{seed}.mcap", seed, seconds=1.2, viscous=0.1, joint=1)
        for seed in range(2)
    ]
    one = record(tmp_path / "one.mcap", 5, joints=LEFT, seconds=1.2)
    realization = load_model(tmp_path / "model.xml").realization
    found = diagnose(realization, read(tmp_path, both, [one]), threads=1)
    assert [(f.effect, f.joint) for f in found.explanation.findings] == [
        ("viscous_friction", "right")
    ]
    assert set(found.errors) == {"left"}
    assert "joint 'right' is not tested: one.mcap lacks it" in found.notes
