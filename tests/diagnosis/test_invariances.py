"""The findings do not depend on order, time or sign convention of the recordings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import STEP, mjcf, reference, simulate, write

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import make_trial

DRY, NOISE, SEEDS = 0.06, 1e-4, (1, 2, 3)


def recorded(
    folder: Path, joints: tuple[str, ...], sign: float = 1.0, later: float = 0.0
) -> list[Path]:
    """Write recordings of pendulums with dry friction, and their nominal model without it.

    Args:
        folder: of model and recordings.
        joints: names of the joints.
        sign: of the joint axes, and thus of all positions and commands.
        later: time in s that is added to all stamps.
    """
    folder.mkdir(parents=True)
    text = mjcf(joints)
    if sign < 0.0:
        text, count = re.subn(r'axis="0 1 0"', 'axis="0 -1 0"', text)
        assert count == len(joints)
    (folder / "model.xml").write_text(text)
    sent, seen = np.arange(0, 22000, 100), np.arange(0, 22000, 50)
    out = []
    for seed in SEEDS:
        # Motion and noise of a joint do not depend on its index in a message.
        setpoints = reference(seed, 2.2, 2)[:, : len(joints)]
        moved = simulate(setpoints, dry=DRY)
        noise = NOISE * np.random.default_rng([seed, 1]).standard_normal((len(seen), 2))
        measured = moved[seen] + noise[:, : len(joints)]
        path = folder / f"{seed}.mcap"
        write(path, joints, sent * STEP + later, sign * setpoints[sent], seen * STEP + later,
              sign * measured, None)  # fmt: skip
        out.append(path)
    return out


def diagnosed(paths: Sequence[Path]) -> Diagnosis:
    """The diagnosis of recordings in the folder of their model; the last one is held out."""
    realization = load_model(paths[0].with_name("model.xml")).realization
    trials = [make_trial(read_recording(p), realization.structure) for p in paths]
    return diagnose(realization, TrialSet(tuple(trials[:-1]), (trials[-1],), ()), threads=1)


def assert_same_findings(a: Diagnosis, b: Diagnosis, tolerance: float) -> None:
    """Fail unless both find the same effects at the same joints, with the same parameters."""
    assert a.verdict == b.verdict
    first, second = a.explanation.findings, b.explanation.findings
    assert [(f.effect, f.joint) for f in first] == [(f.effect, f.joint) for f in second]
    for one, other in zip(first, second, strict=True):
        assert other.confidence == pytest.approx(one.confidence, abs=0.02)
        for name, fitted in one.parameters.items():
            width = fitted.high - fitted.low
            assert other.parameters[name].value == pytest.approx(
                fitted.value, abs=tolerance * max(width, 1e-12)
            ), name


def test_order_and_start_time_of_recordings_and_sign_of_joint_axes_do_not_change_the_findings(
    tmp_path: Path,
) -> None:
    usual = diagnosed(recorded(tmp_path / "usual", ("left",)))
    assert [(f.effect, f.joint) for f in usual.explanation.findings] == [
        ("coulomb_friction", "left")
    ]
    # Gravity and motion are mirrored with the axis, so only signs change.
    first, second, held_out = recorded(tmp_path / "other", ("left",), sign=-1.0, later=86_400.0)
    assert_same_findings(usual, diagnosed([second, first, held_out]), 0.1)
