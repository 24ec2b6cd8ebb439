"""EMPS: compare pytest-twin identify with mujoco.sysid on the same data.

    python benchmarks/identification/side_by_side.py

Both fit the same run and are tested on the same held-out run by the relative error of the force
along the measured motion (inverse dynamics, same filter). mujoco.sysid fits damping, armature and
dry friction by simulation, with the windows and initial states of the diagnosis.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import usual_way

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.recording_rows import RecordingRows, sample
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS

ITERATIONS = 30


def relative(rows: list[RecordingRows], values: np.ndarray) -> float:
    """|measured - predicted| / |measured|, percent."""
    effort = np.concatenate([one.effort[:, 0] for one in rows])
    predicted = np.concatenate([one.matrix[:, 0] @ values for one in rows])
    return 100.0 * float(np.linalg.norm(effort - predicted) / np.linalg.norm(effort))


def main() -> None:
    beside = Path(__file__).resolve().parents[3] / "shared" / "recordings"
    folder = Path(os.environ.get("TWIN_RECORDINGS") or beside) / "emps"
    if not folder.is_dir():
        raise SystemExit("no recordings of EMPS: the variable TWIN_RECORDINGS says where")
    model = folder / "model.xml"
    fit, held = (folder / "recordings" / f"data_emps{name}.mcap" for name in ("", "_pulses"))
    robot = load(model)
    read = [read_measured(p, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS) for p in (fit, held)]
    regressor = Regressor(robot, ["slide"])
    tested = sample(read[1], [regressor] * len(read[1]), choose_filter(read[0]))

    since = time.perf_counter()
    ours = identify_effort(robot, MeasuredRecordings(tuple(read[0]), tuple(read[1])), NO_SIGNALS)
    spent = time.perf_counter() - since
    values = np.zeros(len(regressor.columns))
    values[ours.base.independent] = ours.fitted.values
    equal = np.where([c.kind == "effort_bias" for c in regressor.columns], 0.0, values)

    problem, _ = usual_way.read_case(model, [fit])
    text, told = usual_way.fit(model, problem, ITERATIONS, gains=False)
    with tempfile.TemporaryDirectory() as scratch:
        fitted = Path(scratch) / "fitted.xml"
        fitted.write_text(text)
        theirs = Regressor(load(fitted), ["slide"]).prior
    print(f"{'':48} {'held-out error':>15} {'fit':>9}")
    print(f"{'pytest-twin, mass, viscous, dry, offset':48} {relative(tested, values):13.2f} % "
          f"{spent:7.2f} s")  # fmt: skip
    print(f"{'pytest-twin, without the offset':48} {relative(tested, equal):13.2f} %")
    print(f"{'mujoco.sysid, armature, viscous, dry':48} {relative(tested, theirs):13.2f} % "
          f"{told['seconds']:7.2f} s")  # fmt: skip
    print(f"time of mujoco.sysid over that of pytest-twin: {told['seconds'] / spent:.1f} (goal: 3)")
    for name, one in told["parameters"].items():
        print(f"  mujoco.sysid {name}: {one['value']:.4g}")


if __name__ == "__main__":
    main()
