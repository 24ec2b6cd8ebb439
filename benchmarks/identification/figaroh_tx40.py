"""TX40: compare FIGAROH 1.0.2 with pytest-twin identify on the same recording.

    pip install figaroh==1.0.2
    python benchmarks/identification/figaroh_tx40.py

Both get joint positions and torques of the first four fifths, at 5 kHz. FIGAROH low-passes and
differentiates them as its authors do for this robot (100 Hz, decimated 100 times) and fits weighted
least squares. The coupled wrist is added to its regressor here, because it has no such parameters.
Both are tested on the last fifth with the same regressor along the same filtered motion.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import tx40_files
from figaroh.identification.base_identification import BaseIdentification
from pinocchio.robot_wrapper import RobotWrapper
from tx40 import relative

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.groups import dry_of
from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.least_squares import linear_problem
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.measured_recordings import (
    MeasuredRecording,
    MeasuredRecordings,
    read_measured,
)
from pytest_twin.identification.regressor import Regressor, SharedMotor, structural_base
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

COUPLED = ("Iam6", "fvm6", "fsm6")
CUTOFF, DECIMATED, COUNT = 100.0, 100, 6


class Tx40(BaseIdentification):
    """FIGAROH's identification, with the missing parameters of this robot."""

    def __init__(self, robot: RobotWrapper, recording: MeasuredRecording) -> None:
        self.recording = recording
        super().__init__(robot, "")

    def load_param(self, config_file: str, setting_type: str = "identification") -> None:
        indices = list(range(COUNT))
        self.identif_config: dict[str, Any] = {
            "robot_name": "tx40", "is_joint_torques": True, "is_external_wrench": False,
            "force_torque": None, "has_friction": True, "has_actuator_inertia": True,
            "has_joint_offset": True, "act_idxq": indices, "act_idxv": indices,
            "active_joints": list(self.model.names)[1:], "ts": 1.0 / tx40_files.RATE,
            "cut_off_frequency_butterworth": CUTOFF, "qr_relative_tolerance": 1e-4,
            **{name: [0.0] * COUNT for name in ("fv", "fs", "Ia", "off")},
            "filter_config": {
                "differentiation_method": "gradient",
                "filter_params": {"nbutter": 4, "f_butter": CUTOFF, "med_fil": 5,
                                  "f_sample": tx40_files.RATE},
            },
        }  # fmt: skip

    def load_trajectory_data(self, data_source: str | None = None) -> dict[str, Any]:
        one = self.recording
        return {"timestamps": one.time[:, None], "positions": one.position, "velocities": None,
                "accelerations": None, "torques": one.effort}  # fmt: skip

    def calculate_full_regressor(self) -> None:
        super().calculate_full_regressor()
        v, a = (self.processed_data[name] for name in ("velocities", "accelerations"))
        rows = np.zeros((COUNT, len(v), len(COUPLED)))
        turned = np.sign(v[:, 4] + v[:, 5])
        rows[4] = np.column_stack([a[:, 5], v[:, 5], turned])
        rows[5] = np.column_stack([a[:, 4], v[:, 4], turned])
        added = rows.reshape(-1, len(COUPLED))
        self.dynamic_regressor = np.hstack([self.dynamic_regressor, added])

    def initialize_standard_parameters(self) -> None:
        super().initialize_standard_parameters()
        self.standard_parameter.update(dict.fromkeys(COUPLED, 0.0))

    def _store_results(self, identif_results: dict[str, Any]) -> None:
        """Skip the report of FIGAROH, which does not support additional columns."""
        self.result = {}

    def print_quality_report(self) -> None:
        """Nothing: see above."""


def as_columns(fitted: Tx40, regressor: Regressor) -> np.ndarray:
    """(p,) FIGAROH's base parameters, assigned to their leading parameters; the others are 0."""
    at = {column.symbol: k for k, column in enumerate(regressor.columns)}
    gone = set(fitted._idx_eliminated)
    active = [name for k, name in enumerate(fitted.standard_parameter) if k not in gone]
    numbers = {f"_{name}": str(k) for k, name in enumerate(list(fitted.model.names)[1:], 1)}
    values = np.zeros(len(at))
    for index, value in zip(fitted._base_indices, fitted.phi_base, strict=True):
        symbol = active[index]
        for suffix, number in numbers.items():
            symbol = symbol.replace(suffix, number)
        values[at[symbol]] = value
    return values


def main() -> None:
    source = tx40_files.folder()
    if source is None:
        raise SystemExit("no recordings of the TX40: the variable TWIN_RECORDINGS says where")
    with tempfile.TemporaryDirectory() as scratch:
        paths = tx40_files.write(source, Path(scratch))
        twin = load_twin(paths["twin"])
        file = next(iter(twin.realizations.values())).file
        model = load(file, twin=twin, shapes=False, accept_invalid_inertia=True)
        read = [
            read_measured(paths[name], model, twin.topics, twin.recordings, twin.recordings.signals)
            for name in ("fit", "held_out")
        ]
        since = time.perf_counter()
        ours = identify_effort(
            model, MeasuredRecordings(tuple(read[0]), tuple(read[1])), twin.recordings.signals
        )
        spent = time.perf_counter() - since
        # The model is loaded without meshes, which are not part of the recordings.
        robot = RobotWrapper(pinocchio.buildModelFromUrdf(str(Path(scratch) / "tx40.urdf")))
        since = time.perf_counter()
        theirs = Tx40(robot, read[0][0])
        theirs.initialize()
        theirs.solve(decimate=True, decimation_factor=DECIMATED, plotting=False, wls=True)
        taken = time.perf_counter() - since
    regressor = Regressor(model, tx40_files.JOINTS, [SharedMotor("joint_6", "joint_5")])
    base = structural_base(regressor)
    dry = dry_of(regressor.columns, regressor.joints)[:, base.independent]
    rows = sample(read[1], [regressor], choose_filter(read[0]))
    tested = linear_problem(rows, base.independent, dry)
    print(f"{'held-out effort error in percent':34} " + " ".join(tx40_files.JOINTS) + "  fit")
    for name, values, seconds in (
        ("pytest-twin", ours.fitted.values, spent),
        ("FIGAROH", base.values(as_columns(theirs, regressor)), taken),
    ):
        for moving in (False, True):
            said = name + (", while it moves" if moving else "")
            shown = " ".join(f"{error:7.1f}" for error in relative(tested, values, moving))
            print(f"{said:34} {shown}  {seconds:.1f} s")


if __name__ == "__main__":
    main()
