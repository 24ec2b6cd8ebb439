"""A robot with its approved limits, and what every design of a motion needs of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation import d_optimal
from pytest_twin.excitation.approved_limits import ApprovedLimits, missing_lines
from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.designs import loading_poses
from pytest_twin.excitation.noise import SampleNoise, noise_of
from pytest_twin.excitation.read_limits import missing_error, movable_joints, read_approved
from pytest_twin.identification.regressor.base_parameters import BaseParameters, structural_base
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.loading import load
from pytest_twin.realization.model import Realization
from pytest_twin.realization.record_inputs import with_stale_records
from pytest_twin.twin import Twin, load_twin


@dataclass(frozen=True)
class ApprovedRobot:
    """A robot whose approved limits are read, and whose start is safe.

    Attributes:
        realization, twin, approved, noise: model, twin, limits and measurement noise.
        around: distances of its links to each other and to the environment.
        regressor: regressor of the approved joints.
        seed: seed of all random choices.
    """

    realization: Realization
    twin: Twin
    approved: ApprovedLimits
    noise: SampleNoise
    around: ClearanceChecker
    regressor: Regressor
    seed: int

    @classmethod
    def of(cls, realization: Realization, twin: Twin, seed: int) -> ApprovedRobot:
        """Read the limits.

        Raises:
            SpecError: lines are missing, a value is invalid, or the start is not safe.
        """
        approved = read_approved(realization, twin)
        noise = noise_of(realization, approved)
        around = ClearanceChecker(realization, approved)
        regressor = Regressor(realization, approved.names)
        _refuse_unsafe_start(twin, approved, around, regressor)
        return cls(realization, twin, approved, noise, around, regressor, seed)

    @classmethod
    def load(cls, path: Path, seed: int) -> ApprovedRobot:
        """Load a twin and read its limits.

        Raises:
            SpecError: as :meth:`of`.
        """
        realization, twin = load_twin_model(path)
        if twin is None:
            raise missing_error(path, missing_lines({}, movable_joints(realization)), None)
        return cls.of(realization, twin, seed)

    @cached_property
    def base(self) -> BaseParameters:
        """Base parameters of the approved joints."""
        return structural_base(self.regressor)

    @cached_property
    def loads(self) -> Sequence[Sequence[FloatArray]]:
        """For each joint, poses (j,) that load it differently."""
        return loading_poses(self.approved, self.regressor, self.around.is_clear, self.seed)

    @cached_property
    def optimal(self) -> d_optimal.Design:
        """Design of Fourier series."""
        return d_optimal.Design(
            self.approved, self.regressor, self.base, self.noise.effort, self.around.spare
        )


def load_twin_model(path: Path) -> tuple[Realization, Twin | None]:
    """Return the model of an MJCF, URDF or ``twin.yaml``, and its twin if it has one."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        return load(path), None
    twin = load_twin(path)
    first = twin.first_realization
    realization = load(first.file, twin=twin, name=first.name)
    return with_stale_records(realization), twin


def _refuse_unsafe_start(
    twin: Twin,
    approved: ApprovedLimits,
    around: ClearanceChecker,
    regressor: Regressor,
) -> None:
    near = around.too_near(approved.start)
    if near:
        said = "; ".join(
            f"{one.pair[0]} and {one.pair[1]} {one.distance:.4g} m (least {one.required:.4g} m)"
            for one in near
        )
        raise twin.error(
            "excitation.clearance",
            f"the start is not clear: {said}",
            expected="another start:, distances of these pairs under clearance.pairs, or, where "
            "they may touch, clearance.ignore",
        )
    box = around.least_box_spare(approved.start[None])
    if box is not None and box[0] < 0.0:
        raise twin.error(
            "excitation.workspace", f"at the start {box[1]!r} is outside its box",
            value=round(-box[0], 6), unit="m beyond", expected="a start inside all boxes",
        )  # fmt: skip
    still = np.zeros((1, len(approved.joints)))
    effort = regressor.matrix(approved.start[None], still, still)[0] @ regressor.prior
    for joint, value, limit in zip(approved.joints, effort, approved.effort, strict=True):
        if abs(value) > limit:
            raise twin.error(
                f"excitation.joints.{joint.name}.effort",
                "gravity alone needs more at the start",
                value=f"{limit:.4g} (with the margin)", unit=joint.effort_unit,
                expected=f"at least {abs(value):.4g} {joint.effort_unit}",
            )  # fmt: skip
