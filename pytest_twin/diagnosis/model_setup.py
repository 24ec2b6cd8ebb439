"""The model of a diagnosis with its simulation settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from pytest_twin.diagnosis.patched.delays import effects_outside_mjcf, without_delays
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.diagnosis.patched.replay import fixed_values
from pytest_twin.diagnosis.prepare import (
    PreparedProblem,
    SimulationSettings,
    prepare,
    shared_joints,
)
from pytest_twin.diagnosis.problem import CandidateMask
from pytest_twin.diagnosis.temperature import ColdFractions
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.estimation.hypothesis import Scales
from pytest_twin.realization import Realization
from pytest_twin.servos.prior import priors_of
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class ModelSetup:
    """A model with its simulation settings.

    Attributes:
        realization: the nominal model, without delay lines.
        outside_mjcf: effects that are simulated in addition to the model.
        cold_fractions: normalized temperatures of an earlier diagnosis; empty to take them from the
            trials.
        has_friction_creep: whether a joint creeps under dry friction, as with MuJoCo's default
            constraint.
        substeps: if a simulation made the recordings: its steps for each step of the model; 0 for
            recordings of a robot.
        is_of_robot: whether the metadata of all recordings name a robot as their source. No
            simulation is then searched for.
        threads: threads of the simulation, 0 for all cores.
        mask: effects among which a search chooses; None for all.
    """

    realization: Realization
    outside_mjcf: tuple[AppliedEffect, ...] = ()
    cold_fractions: ColdFractions = field(default_factory=dict)
    has_friction_creep: bool = False
    substeps: int = 0
    is_of_robot: bool = False
    threads: int = 0
    mask: CandidateMask | None = None

    @classmethod
    def of(
        cls, realization: Realization, inherited: PatchedModel | None, threads: int = 0
    ) -> ModelSetup:
        """The setup of a model, nominal or patched by an earlier diagnosis.

        Whether a simulation made the recordings is detected anew for each set of recordings.

        Args:
            inherited: effects of an earlier diagnosis that its MJCF cannot hold.
            threads: threads of the simulation, 0 for all cores.
        """
        cold_fractions = {} if inherited is None else inherited.cold_fractions
        has_friction_creep = inherited is not None and inherited.has_friction_creep
        outside_mjcf = effects_outside_mjcf(realization, inherited)
        return cls(
            without_delays(realization),
            outside_mjcf,
            cold_fractions,
            has_friction_creep,
            threads=threads,
        )

    def prepare(
        self,
        fit: Sequence[Trial],
        held_out: Sequence[Trial],
        window: float | None = None,
        contact: ContactGeoms | None = None,
        scales: Scales | None = None,
    ) -> PreparedProblem:
        """The problem of explaining ``fit`` and predicting ``held_out``.

        Arguments and errors are those of :func:`~pytest_twin.diagnosis.prepare.prepare`.
        """
        joints = shared_joints(self.realization, (*fit, *held_out))
        prepared = prepare(
            self.realization, fit, held_out,
            threads=self.threads, window=window, contact=contact,
            settings=SimulationSettings(
                self.cold_fractions, fixed_values(self.outside_mjcf, joints, 1),
                self.has_friction_creep, self.substeps, scales,
            ),
        )  # fmt: skip
        twin = self.realization.twin
        priors = () if twin is None else tuple(priors_of(twin.servos))
        return replace(prepared, problem=replace(prepared.problem, mask=self.mask, priors=priors))
