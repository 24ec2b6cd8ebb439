"""The model of a diagnosis with its simulation settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pytest_twin.diagnosis.hypothesis import Scales
from pytest_twin.diagnosis.patched.delays import stepped_beside, without_delays
from pytest_twin.diagnosis.patched.model import AppliedEffect, Patched
from pytest_twin.diagnosis.patched.replay import fixed_values
from pytest_twin.diagnosis.prepare import Prepared, Simulated, prepare, shared_joints
from pytest_twin.diagnosis.temperature import Coldness
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class ModelSetup:
    """A model with its simulation settings.

    Attributes:
        realization: the nominal model, without delay lines.
        beside: effects that are simulated in addition to the model.
        coldness: normalized temperatures of an earlier diagnosis; empty to take them from the
            trials.
        creeps: whether a joint creeps under dry friction, as with MuJoCo's default constraint.
        substeps: if a simulation made the recordings: its steps for each step of the model; 0 for
            recordings of a robot.
        threads: threads of the simulation, 0 for all cores.
    """

    realization: Realization
    beside: tuple[AppliedEffect, ...] = ()
    coldness: Coldness = field(default_factory=dict)
    creeps: bool = False
    substeps: int = 0
    threads: int = 0

    @classmethod
    def of(
        cls, realization: Realization, inherited: Patched | None, threads: int = 0
    ) -> ModelSetup:
        """The setup of a model, nominal or patched by an earlier diagnosis.

        Whether a simulation made the recordings is detected anew for each set of recordings.

        Args:
            realization: the model.
            inherited: effects of an earlier diagnosis that its MJCF cannot hold.
            threads: threads of the simulation, 0 for all cores.
        """
        coldness = {} if inherited is None else inherited.coldness
        creeps = inherited is not None and inherited.creeps
        beside = stepped_beside(realization, inherited)
        return cls(without_delays(realization), beside, coldness, creeps, threads=threads)

    def prepared(
        self,
        fit: Sequence[Trial],
        held_out: Sequence[Trial],
        window: float | None = None,
        contact: ContactGeoms | None = None,
        scales: Scales | None = None,
    ) -> Prepared:
        """The problem of explaining ``fit`` and predicting ``held_out``.

        Arguments and errors are those of :func:`~pytest_twin.diagnosis.prepare.prepare`.
        """
        joints = shared_joints(self.realization, (*fit, *held_out))
        return prepare(
            self.realization, fit, held_out,
            threads=self.threads, window=window, contact=contact,
            simulated=Simulated(
                self.coldness, fixed_values(self.beside, joints, 1), self.creeps, self.substeps,
                scales,
            ),
        )  # fmt: skip
