"""Online update of friction on real servos, in the order of the recordings.

    python benchmarks/real/online_update.py RECORDINGS [SET...]

RECORDINGS is the folder with ``xl330`` and ``so101``. Each window of 0.5 s is predicted from its
first measured state before it updates the parameters. Both columns are over the same windows.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from pytest_twin.adaptation.recursive import Recursion, base_parameters, track
from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.realization import load
from pytest_twin.replay import row_of
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

WINDOW = 0.5
BOUNDS = {
    "xl330": {"viscous_friction": (0.0, 0.3), "coulomb_friction": (0.0, 0.2)},
    "so101": {"viscous_friction": (0.0, 3.0), "coulomb_friction": (0.0, 0.5)},
}
MOST_RECORDINGS = {"xl330": 16, "so101": 2}


def run(folder: Path, name: str) -> None:
    """Print the errors of base and update for one set."""
    twin = load_twin(folder / "twin.yaml") if (folder / "twin.yaml").is_file() else None
    realization = load(folder / "model.xml", twin=twin)
    topics = DEFAULT_TOPICS if twin is None else twin.topics
    trials = [
        trial
        for path in sorted((folder / "recordings").iterdir())[: MOST_RECORDINGS[name]]
        for recording in recordings_at(path, topics)
        for trial in make_trials(recording, realization.structure)
    ]
    trials.sort(key=lambda trial: trial.start)
    rows = [row_of(realization, trial) for trial in trials]
    parameters = {
        f"{joint}.{kind}": span
        for joint in trials[0].command_joints
        for kind, span in BOUNDS[name].items()
    }
    spec = UpdateSpec(name, parameters, window=WINDOW)
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    began = time.perf_counter()
    windows = track(recursion, rows)
    seconds = time.perf_counter() - began
    base = np.array([w.base_rms for w in windows])
    update = np.array([w.updated_rms for w in windows])
    print(f"{name}: {len(trials)} trials, {len(windows)} windows, {seconds:.0f} s")
    for title, of in (
        ("root mean square", lambda v: np.sqrt(np.mean(v**2))),
        ("median", np.median),
    ):
        was, now = 1e3 * of(base), 1e3 * of(update)
        print(f"  {title}: {was:.2f} -> {now:.2f} mrad ({100 * (now / was - 1):+.1f} %)")
    better = float(np.mean(update < base))
    worst = f"{1e3 * base.max():.1f} -> {1e3 * update.max():.1f} mrad"
    print(f"  better in {100 * better:.0f} % of the windows, worst window {worst}")
    for at, parameter in enumerate(parameters):
        print(f"  {parameter}: {recursion.base[at]:.4g} -> {recursion.value[at]:.4g}")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    root = Path(sys.argv[1])
    for which in sys.argv[2:] or list(BOUNDS):
        run(root / which, which)
