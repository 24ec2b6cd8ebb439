"""Settings of the meaning of recorded signals: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InterpolationSettings:
    """Thresholds by which a setpoint between two commands is held, interpolated or ramped.

    They were chosen on simulated cells of all three kinds with jitter, delays and missing physics.
    RMS residuals are compared in multiples of the encoder noise.

    Attributes:
        seconds: duration in s of each recording that is used, from shortly before its first change
            of command. With ``most_recordings`` it separates a shift of 2 ms from none at the noise
            of an encoder, at a tenth of the cost of all data.
        most_recordings: number of recordings that are used.
        seconds_before: time before the first motion that is fitted too, s.
        ruled_out: log-likelihood ratio over all recordings from which an alternative is ruled out:
            odds of 22,000 to 1. It uses the effective sample size, which is small for a residual of
            missing physics. Between 5 and 20 no case of the tests changes.
        less: largest ratio of the mean squared residuals of the answer and of an alternative, at
            the joint with the smallest ratio. A smaller difference may come from physics that is
            not modelled.
        far_less: the same if the residual of the answer exceeds ``near`` times the noise, or if the
            fit of the alternative has not converged.
        near: largest residual, in multiples of the noise, of a fit that explains the recording.
        alike: ratio of RMS residuals up to which two assumptions explain a recording equally well.
        most_by_model: confidence if only the model decides, because it needs no correction or fewer
            effects.
        model_apart: smallest ratio of the nominal RMS residuals of an alternative and of the answer
            for this. Ordinary servos add delays that no model has. One of them hides the difference
            by chance with a probability of about the reciprocal.
        model_closer: ratio of the RMS residuals of the nominal model, at one joint or multiplied
            over joints, from which an open question is left at the assumption that is closer to the
            model.
        most_doubted: largest confidence of an effect that the interpolation of the commands may
            explain alone.
        same_period: ratio of command periods up to which recordings are treated as from one
            controller.
        jump: a command steps if it changes in one period by this many times the change in the
            period before and after, ...
        jump_of_range: ... and by this share of its range.
        settles: time after a step in s from which its time is fitted. Ordinary drives settle within
            it.
    """

    seconds: float = 2.5
    most_recordings: int = 3
    seconds_before: float = 0.2
    ruled_out: float = 10.0
    less: float = 0.7
    far_less: float = 0.25
    near: float = 3.0
    alike: float = 1.25
    most_by_model: float = 0.9
    model_apart: float = 4.0
    model_closer: float = 2.0
    most_doubted: float = 0.5
    same_period: float = 1.2
    jump: float = 5.0
    jump_of_range: float = 0.1
    settles: float = 0.4


@dataclass(frozen=True, slots=True)
class JointFitSettings:
    """Thresholds of the fit of one joint by which assumptions about signals are compared.

    They were chosen on the same cells.

    Attributes:
        iterations: largest number of Levenberg-Marquardt iterations.
        least_gain: gain of the log-posterior for each joint below which a fit has converged.
        at_noise: RMS residual, in encoder noises, up to which only noise remains.
        far: RMS residual, in encoder noises, from which far more than noise remains.
        smooth_samples: number of correlated samples that count as one independent sample, while the
            residual is smooth.
    """

    iterations: int = 6
    least_gain: float = 1.0
    at_noise: float = 1.1
    far: float = 3.0
    smooth_samples: float = 10.0


@dataclass(frozen=True, slots=True)
class VelocitySettings:
    """Thresholds by which a recorded velocity is a sensor's, differenced or filtered.

    They were chosen on simulated recordings of each kind with encoder noise and jitter.

    Attributes:
        fewest_samples: smallest number of samples from which the origin of a velocity is
            determined.
        derived: largest deviation of a velocity from differences of the positions, as a share of
            the noise of these differences. The velocity of an independent sensor deviates by the
            whole noise.
        filters: smallest weight of the previous velocity that shows a low-pass filter.
        even: largest deviation from an even sample period, as a share of it.
        shared: number of differences in which each sample takes part.
        surely: smallest age of a velocity that is reported, in standard errors, ...
        least_age: ... and in sample periods. A motion whose acceleration jumps at the samples seems
            up to a sixth of a period old.
    """

    fewest_samples: int = 50
    derived: float = 0.2
    filters: float = 0.05
    even: float = 0.2
    shared: float = 3.0
    surely: float = 5.0
    least_age: float = 0.25


INTERPOLATION = InterpolationSettings()
JOINT_FIT = JointFitSettings()
RECORDED_VELOCITY = VelocitySettings()
