"""Frequency response from command to joint, at frequencies with sufficient coherence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks import proposals
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.drive import (
    BENCH_SCHEMA,
    TARGET_SCHEMA,
    Drive,
    command_unit,
    prepare,
)
from pytest_twin.checks.fields import quantity, spec_error
from pytest_twin.checks.poses import keyframe_parts
from pytest_twin.checks.scalar_measures import scalar_measures
from pytest_twin.checks.schemas import array, choice, integer, number, quantity_field, table
from pytest_twin.dependency import Structure
from pytest_twin.errors import TwinError
from pytest_twin.golden import Golden
from pytest_twin.metrics import frequency
from pytest_twin.words import counted

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_SCALARS = {"bandwidth": "Hz", "resonance": "Hz", "resonance_peak": "dB"}
_UNDEFINED = {
    "bandwidth": "no fall by 3 dB on the lines that are carried",
    "resonance": "no peak inside the band that is carried",
    "resonance_peak": "no peak inside the band that is carried",
}
_LINES = 30
"""Default number of frequencies of a multisine."""
_REALIZATIONS = 6
"""Default number of commands with different phases."""
_PERIODS = 2
"""Default number of evaluated periods."""
_TRANSIENT_PERIODS = 1
"""Default number of periods before the evaluated ones."""
_COHERENCE = 0.95
"""Default of the smallest coherence that is reported."""
_SAMPLES = 1_000_000  # bound on steps of all realizations together


@dataclass(frozen=True, slots=True)
class _Plan:
    """The excitation: one period of every realization with peak 1, and its repetitions."""

    signals: FloatArray  # (realizations, samples)
    harmonics: frequency.IntArray
    period: float
    transient_periods: int
    periods: int


class FrequencyResponse(Check):
    """Response to a periodic multisine or chirp on one joint's command.

    Spectra use whole periods after the transient ones, so there is no leakage. The result is the
    transfer function of the discrete steps. Its phase lags that of the continuous joint by less
    than pi f h rad (half a timestep h), because commands are held over each step.

    ``values``: ``bandwidth`` and ``resonance`` in Hz, ``resonance_peak`` in dB relative to the
    lowest line, each None if the lines do not determine it; ``lines_excited``, ``lines_carried``
    (with sufficient coherence), ``coherence_required``. The trace has magnitude, phase and
    coherence of these lines.
    """

    kind: ClassVar[str] = "frequency_response"
    dynamic: ClassVar[bool] = True
    tolerances: ClassVar[Mapping[str, str]] = {
        "magnitude": "dB",
        "phase": "rad",
        "coherence": "1",
        **_SCALARS,
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": TARGET_SCHEMA,
        "stimulus": table(
            {
                "signal": choice(
                    ["multisine", "chirp"],
                    "multisine (default): selected frequencies with equal amplitudes, random "
                    "phases and a low crest factor. chirp: a sweep over all frequencies of the "
                    "band.",
                ),
                "amplitude": quantity_field(
                    "Peak of the command relative to the holding command, such as '2 deg' or '0.1 "
                    "N*m'."
                ),
                "band": array(
                    quantity_field("A frequency, such as '0.5 Hz'."),
                    "Lowest and highest frequency of the excitation, in Hz or with a unit.",
                    count=2,
                ),
                "period": quantity_field(
                    "Length of one period, such as '4 s'. Its inverse is the frequency resolution."
                ),
                "lines": integer(
                    "Number of frequencies of a multisine, at equal ratios. Default: 30.",
                    minimum=2,
                    maximum=400,
                ),
                "realizations": integer(
                    "Number of commands with the same amplitude spectrum and different phases. "
                    "Default: 6. A chirp has at most 8.",
                    minimum=2,
                    maximum=64,
                ),
                "periods": integer(
                    "Number of evaluated periods of each command. Default: 2.",
                    minimum=1,
                    maximum=64,
                ),
                "transient_periods": integer(
                    "Number of periods before the evaluated ones, in which the transient decays. "
                    "Default: 1.",
                    minimum=1,
                    maximum=64,
                ),
                "coherence": number(
                    "Smallest coherence of a frequency that is reported. Default: 0.95.",
                    exclusiveMinimum=0,
                    maximum=1,
                ),
                "seed": integer("Seed of the random phases. Default: 1.", minimum=0),
                **BENCH_SCHEMA,
            },
            required=["amplitude", "band", "period"],
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts that affect the joint's motion, and the named keyframe."""
        return set(structure.dynamics([golden.target["joint"]])) | keyframe_parts(golden, structure)

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Hold, settle and excite the joint; realizations are rows of one batch."""
        unit = command_unit(golden, realization)
        amplitude = quantity(golden, "stimulus.amplitude", golden.stimulus["amplitude"], unit)
        if not amplitude > 0.0:
            raise spec_error(
                golden, "stimulus.amplitude", "the amplitude is not above zero", value=amplitude,
                unit=unit, expected="more than 0",
            )  # fmt: skip
        plan = _plan(golden, float(realization.model.opt.timestep))
        drive = prepare(golden, realization, (-amplitude, amplitude))
        command = amplitude * np.tile(plan.signals, (1, plan.transient_periods + plan.periods))
        response = _excite(drive, command, plan, progress)
        shape = (plan.signals.shape[0], plan.periods, plan.signals.shape[1])
        first = plan.transient_periods * plan.signals.shape[1]
        required = float(golden.stimulus.get("coherence", _COHERENCE))
        found = frequency.frequency_response(
            command[:, first:].reshape(shape),
            response[:, first:].reshape(shape),
            plan.harmonics,
            plan.period,
            coherence=required,
        )
        if found.frequency.size == 0:
            raise spec_error(
                golden,
                "stimulus",
                f"no line of {found.excited.size} reaches the required coherence: highest "
                f"{found.best:.3g}",
                expected=f"coherence of at least {required:g}, by another amplitude or band",
            )
        peak = frequency.resonance(found)
        return Observation(
            values={
                "bandwidth": frequency.bandwidth(found),
                "resonance": None if peak is None else peak[0],
                "resonance_peak": None if peak is None else peak[1],
                "lines_excited": int(found.excited.size),
                "lines_carried": int(found.frequency.size),
                "coherence_required": required,
            },
            trace=Trace(
                axis=("frequency", "Hz"),
                x=found.frequency,
                columns={
                    "magnitude": (_ratio(drive.response_unit, unit), found.magnitude),
                    "phase": ("rad", found.phase),
                    "coherence": ("1", found.coherence),
                },
            ),
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare the worst line of magnitude, phase and coherence, bandwidth and resonance."""
        joint = golden.target["joint"]
        measures = scalar_measures(
            golden, _SCALARS, observation.values, joint, undefined=_UNDEFINED
        )
        if stored is None or observation.trace is None:
            return measures
        return measures + _line_measures(golden, joint, observation.trace, stored)

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose the first, middle and last commanded joint with a coherent response."""
        proposals.require_mass(realization)
        joints = proposals.drivable(realization)
        chosen = sorted({0, len(joints) // 2, len(joints) - 1}) if joints else []
        timestep = float(realization.model.opt.timestep)
        highest = min(50.0, float(f"{0.1 / timestep:.1g}"))
        specs: list[Mapping[str, Any]] = []
        swallowed: list[str] = []
        for joint, command in (joints[i] for i in chosen):
            answer = "position" if command == "position" else "velocity"
            spec: dict[str, Any] = {
                "name": joint,
                "title": f"Frequency response of {joint}: {answer} over {command} command",
                "target": {"joint": joint, "command": command},
                "stimulus": {
                    "amplitude": abs(proposals.first_amplitude(realization, joint, command, 0.5)),
                    "band": ["0.5 Hz", f"{highest:g} Hz"],
                    "period": "4 s",
                    **proposals.first_bench(realization, command),
                },
                "tolerance": {
                    "magnitude": "0.1 dB",
                    "phase": "1 deg",
                    "bandwidth": "0.1 Hz",
                    "resonance": "0.1 Hz",
                    "resonance_peak": "0.2 dB",
                },
            }
            amplitude = spec["stimulus"]["amplitude"]
            # Saturation distorts large motions, dry friction small ones: use the largest linear
            # one.
            for share in (1.0, 0.1, 0.01):
                spec["stimulus"]["amplitude"] = float(f"{share * amplitude:.3g}")
                if self._is_coherent(spec, realization):
                    specs.append(spec)
                    break
            else:
                swallowed.append(joint)
        if not specs:
            raise NothingToProposeError(
                f"{', '.join(swallowed)}: no small command gives a coherent response"
                if swallowed
                else "no joint takes a command"
            )
        left_out = len(joints) - len(specs) - len(swallowed)
        notes = []
        if left_out:
            notes.append(
                f"Left out: {counted(left_out, 'more joint')}, because each takes seconds. Add "
                "those whose gain or resonance matters."
            )
        if swallowed:
            notes.append(
                f"Left out: {', '.join(swallowed)}, because dry friction, a stop or saturation "
                "hides the answer to a small command."
            )
        return [{**spec, "notes": notes} for spec in specs]

    def _is_coherent(self, spec: Mapping[str, Any], realization: Realization) -> bool:
        """Whether every line is coherent, despite dry friction, stops and saturation."""
        fewer = {**spec, "stimulus": {**spec["stimulus"], "realizations": 3}}
        trial = proposals.draft(self, realization, fewer)
        try:
            values = self.observe(trial, realization, lambda _: None).values
        except TwinError:
            return False
        return bool(values["lines_carried"] == values["lines_excited"])


def _ratio(response_unit: str, command_unit: str) -> str:
    if response_unit == command_unit:
        return "1"
    return response_unit if command_unit == "1" else f"({response_unit})/({command_unit})"


def _plan(golden: Golden, timestep: float) -> _Plan:
    stimulus = golden.stimulus
    period = quantity(golden, "stimulus.period", stimulus["period"], "s")
    low, high = (
        quantity(golden, f"stimulus.band.{i}", value, "Hz")
        for i, value in enumerate(stimulus["band"])
    )
    samples = round(period / timestep) if 0.0 < period <= 600.0 else 0
    realizations = int(stimulus.get("realizations", _REALIZATIONS))
    periods = int(stimulus.get("periods", _PERIODS))
    transient = int(stimulus.get("transient_periods", _TRANSIENT_PERIODS))
    total = samples * realizations * (periods + transient)
    if not samples >= 4 or total > _SAMPLES:
        raise spec_error(
            golden, "stimulus.period", "out of bounds", value=period, unit="s",
            expected=f"up to {_SAMPLES} steps of {timestep:g} s in all",
        )  # fmt: skip
    period = samples * timestep
    lowest, highest = math.ceil(low * period - 1e-6), math.floor(high * period + 1e-6)
    if not 1 <= lowest < highest or 4 * highest > samples:
        raise spec_error(
            golden, "stimulus.band", "the band does not fit the period and the timestep",
            value=f"{low:g} to {high:g}", unit="Hz",
            expected=f"within {1.0 / period:.6g} to {0.25 / timestep:.6g} Hz, lowest first",
        )  # fmt: skip
    if stimulus.get("signal", "multisine") == "chirp":
        if realizations > 8:
            raise spec_error(
                golden, "stimulus.realizations", "too many realizations for a chirp",
                value=realizations, expected="2 to 8",
            )  # fmt: skip
        harmonics = np.arange(lowest, highest + 1)
        signals = [frequency.chirp(samples, lowest, highest, i) for i in range(realizations)]
    else:
        harmonics = frequency.log_harmonics(lowest, highest, int(stimulus.get("lines", _LINES)))
        seed = int(stimulus.get("seed", 1))
        signals = [frequency.multisine(samples, harmonics, (seed, i)) for i in range(realizations)]
    return _Plan(np.stack(signals), harmonics, period, transient, periods)


def _excite(drive: Drive, command: FloatArray, plan: _Plan, progress: Progress) -> FloatArray:
    """Return the (realizations, steps) response at the time of each command sample."""
    from pytest_twin.realization import simulate

    model, data = drive.model, drive.data
    samples = plan.signals.shape[1]
    # Fade-in over the first period prevents drift of a joint that is not held.
    fade = 0.5 - 0.5 * np.cos(np.pi * np.arange(samples) / samples)
    faded = command.copy()
    faded[:, :samples] *= fade
    rows, steps = command.shape
    control = np.tile(data.ctrl, (rows, steps, 1))
    applied = np.zeros((rows, steps, 0))
    if drive.input is None:
        applied = np.zeros((rows, steps, model.nv))
        applied[..., drive.dof] = faded
    else:
        control[..., drive.input.control] = drive.input.scale * (drive.hold + faded)
    qpos, qvel = simulate.simulate_batch(model, data, control, applied, progress)
    after = drive.series(qpos, qvel)
    start = drive.series(data.qpos, data.qvel)
    return np.concatenate((np.full((rows, 1), start), after[:, :-1]), axis=1)


def _line_measures(golden: Golden, joint: str, now: Trace, stored: Trace) -> list[Measure]:
    """Compare every stored line with its present value; lines without coherence fail."""
    resolution = float(np.diff(stored.x).min()) if stored.x.size > 1 else float(stored.x[0])
    nearest = np.abs(stored.x[:, None] - now.x).min(axis=1)
    lost = nearest > 0.25 * resolution
    measures = []
    for name in ("magnitude", "phase", "coherence"):
        bound = golden.tolerance.get(name)
        if bound is None or name not in stored.columns:
            continue
        then = stored.columns[name][1]
        found = np.interp(stored.x, now.x, now.columns[name][1])
        error = np.abs(found - then)
        if name == "magnitude":
            found, then = frequency.decibel(found), frequency.decibel(then)
            error = np.abs(found - then)
        elif name == "phase":
            error = np.abs((found - then + np.pi) % (2.0 * np.pi) - np.pi)
        error = np.where(lost, np.nan, error)
        worst = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
        at = f"{joint} at {stored.x[worst]:.4g} Hz"
        if lost[worst]:
            at += f": not carried now ({int(lost.sum())} of {lost.size} lines are not)"
        measures.append(
            Measure(
                name=name,
                subject=at,
                measured=math.nan if lost[worst] else float(found[worst]),
                golden=float(then[worst]),
                error=float(error[worst]),
                tolerance=bound.value,
                unit=bound.unit,
            )
        )
    return measures
