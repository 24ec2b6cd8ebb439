"""The gate on recordings of a real arm: declared tolerances pass, a tight one fails per joint."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

TIGHT = Path(__file__).parent / "tight"


def test_the_declared_goldens_pass_and_are_released(so101) -> None:
    ran = so101.pytest("--twin-release")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "9 passed" in ran.stdout
    (release,) = (so101.root / "releases").glob("[0-9]*")
    assert (release / "release.dsse.json").is_file()
    # The release lists the recordings by digest and does not copy them.
    assert not list(so101.root.rglob("*.mcap"))
    assert "staircase_motion.mcap" in (release / "results.json").read_text()


@pytest.mark.nightly
def test_a_tight_tolerance_fails_with_the_margin_of_each_joint(so101) -> None:
    shutil.copytree(TIGHT, so101.root / "golden" / "tight")
    ran = so101.pytest("--twin-release", "golden/tight")
    assert ran.returncode == 1, ran.stdout + ran.stderr
    # The vendor's model compared with the robot over 41 s: RMS in rad, margin to 0.01 rad.
    table = [line.split() for line in ran.stdout.splitlines() if "(recording)" in line]
    rows = {words[2]: words for words in table}
    verdicts = {joint: words[0] for joint, words in rows.items()}
    assert verdicts == {
        "shoulder_pan": "FAIL",
        "shoulder_lift": "FAIL",
        "elbow_flex": "FAIL",
        "wrist_flex": "ok",
        "wrist_roll": "FAIL",
        "gripper": "ok",
    }
    (measured,) = re.findall(r" (\S+) rad 0 rad \(recording\) ", " ".join(rows["elbow_flex"]))
    margin = rows["elbow_flex"][-1]
    assert float(measured) == pytest.approx(0.0804, rel=0.02)
    assert float(margin) == pytest.approx(0.01 - float(measured), abs=1e-4)
    assert not (so101.root / "releases").exists()
