"""Settings of the detection of a simulator's step and friction: each with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class IntegratorSettings:
    """Thresholds by which a recording comes from a simulation, or a step is too coarse.

    They were chosen on recordings simulated by MuJoCo at 2 ms and by integration at 0.1 ms.

    Attributes:
        left: greatest share of the residual above the noise with the right step or friction
            constraint of a simulation.
        least_evidence: smallest log-likelihood ratio over all recordings for a simulation: odds of
            150 to 1. Three recordings of 4 s at 100 Hz, made by MuJoCo at 2 ms, reach 13 if the
            integration error is 20 % of the noise; two reach 10.
        noise_alone: largest RMS residual that counts as noise only, in standard deviations of the
            encoder noise. The noise is estimated from neighbouring samples, to within a tenth: 0.18
            mrad where 0.2 were added.
        effort_closer: largest ratio of the effort residual of a simulation to that of a robot for
            which the recording comes from a simulation.
        seen: smallest RMS integration error that is tested, in standard deviations of the encoder
            noise. A smaller one is not detectable with a thousand samples.
        note_floors: smallest residual in noise floors for a note about a coarse step.
        note_ratio: smallest ratio of integration error to residual for the note.
        cause_share: ratio of integration error to the nominal model's error above which the
            integration error may be the cause of a finding.
    """

    left: float = 0.5
    least_evidence: float = 5.0
    noise_alone: float = 1.2
    effort_closer: float = 0.5
    seen: float = 0.2
    note_floors: float = 2.0
    note_ratio: float = 3.0
    cause_share: float = 0.5


INTEGRATOR = IntegratorSettings()
