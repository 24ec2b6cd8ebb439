"""Read the two hypotheses that a motion has to distinguish, and what a diagnosis says of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.effects import catalogue
from pytest_twin.effects.proposal import starting_sizes
from pytest_twin.errors import FormatError, SpecError
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term
from pytest_twin.realization.patch import suggest

DIAGNOSIS_FILE = "diagnosis.json"
_MOST_STARTS = 12
"""Largest number of starting values of one hypothesis. Laws with more have finely spaced ones."""
_OPTION = "--separate"


@dataclass(frozen=True)
class Diagnosed:
    """What a diagnosis says that the design of a motion uses.

    Attributes:
        path: its file.
        parameters: (effect, joint) -> reported parameter -> value, SI units; joint None for the
            whole robot.
        joints: effect -> joints at which findings and alternatives have it, likeliest first.
        noise: joint -> RMS error that remains on held-out recordings, at least the noise floor, in
            rad or m.
        effort_noise: joint -> the same for efforts, N*m or N.
    """

    path: Path
    parameters: Mapping[tuple[str, str | None], Mapping[str, float]] = field(default_factory=dict)
    joints: Mapping[str, Sequence[str | None]] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    effort_noise: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Rival:
    """One of the hypotheses that a motion has to distinguish.

    Attributes:
        term: the effect and the column of its joint.
        name: as the command line writes it, ``coulomb_friction@elbow``.
        diagnosed: reported parameter -> value of a diagnosis, SI units; empty without one.
    """

    term: Term
    name: str
    diagnosed: Mapping[str, float] = field(default_factory=dict)

    def starts(self, scales: Scales) -> list[Hypothesis]:
        """Parameter values from which a fit of this hypothesis begins; both signs of a size."""
        sizes = starting_sizes(self.term.law)
        if len(sizes) > _MOST_STARTS:
            chosen = np.linspace(0, len(sizes) - 1, _MOST_STARTS).round().astype(int)
            sizes = [sizes[i] for i in chosen]
        found = [Hypothesis((self.term,), size) for size in sizes]
        known = self._known(scales)
        return found if known is None else [known, *found]

    def assumed(self, scales: Scales) -> Hypothesis:
        """The parameters that the design takes for true: of the diagnosis, else typical ones."""
        sizes = starting_sizes(self.term.law)
        return self._known(scales) or Hypothesis((self.term,), sizes[len(sizes) // 2])

    def _known(self, scales: Scales) -> Hypothesis | None:
        if not self.diagnosed:
            return None
        theta = starting_sizes(self.term.law)[0].copy()
        for k, parameter in enumerate(self.term.parameters):
            value = self.diagnosed.get(parameter.reported_name)
            if value is None:
                theta[k] = parameter.absent_value
                continue
            # The reciprocal is its own inverse.
            fitted = parameter.reported(value)
            theta[k] = fitted / scales.value(parameter, self.term.joint)
        hypothesis = Hypothesis((self.term,), theta)
        return hypothesis.with_theta(np.clip(theta, *hypothesis.bounds))


def read_diagnosed(folder: Path) -> Diagnosed:
    """Read what a diagnosis says of its findings, alternatives and noise.

    Raises:
        FormatError: the folder has no diagnosis, or it is not one.
    """
    path = folder / DIAGNOSIS_FILE if folder.is_dir() else folder
    try:
        document = json.loads(path.read_text())
        findings = [*document["findings"], *document.get("small_corrections", [])]
        parameters: dict[tuple[str, str | None], dict[str, float]] = {}
        joints: dict[str, list[str | None]] = {}
        for finding in findings:
            joints.setdefault(finding["effect"], []).append(finding["joint"])
            parameters[finding["effect"], finding["joint"]] = {
                name: float(one["value"]) for name, one in finding["parameters"].items()
            }
        for candidate in document.get("candidates", []):
            joints.setdefault(candidate["effect"], []).append(candidate["joint"])
        for finding in findings:
            for other in finding["alternatives"]:
                # Without "joint" an alternative acts at the joint of the finding.
                joints.setdefault(other["effect"], []).append(other.get("joint", finding["joint"]))
        return Diagnosed(
            path, parameters, joints,
            _rms(document.get("held_out") or {}, "floor", "rms_after")
            or _rms(document.get("position") or {}, "rms_usual", "rms_after"),
            _rms(document.get("effort") or {}, "rms_usual", "rms_after"),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(
            f"not a diagnosis: {type(error).__name__}: {error}", path=path, where="--diagnosis",
            expected=f"the folder that pytest-twin diagnose wrote, with {DIAGNOSIS_FILE}",
        ) from None  # fmt: skip


def _rms(document: Mapping[str, Any], floor: str, after: str) -> dict[str, float]:
    sizes = {joint: max(float(one[floor]), float(one[after])) for joint, one in document.items()}
    return {joint: size for joint, size in sizes.items() if np.isfinite(size) and size > 0.0}


def read_rivals(
    words: str, joints: Sequence[str], modes: Sequence[str] | None, diagnosed: Diagnosed | None
) -> tuple[Rival, Rival]:
    """Read ``EFFECT[@JOINT],EFFECT[@JOINT]``.

    Args:
        joints: joints that may move.
        modes: command mode of each joint; None if the model has no servos.

    Raises:
        SpecError: an effect or a joint is unknown, cannot act, or is not determined.
    """
    names = [word.strip() for word in words.split(",")]
    if len(names) != 2 or not all(names):
        raise _refused("not two effects", words, "EFFECT[@JOINT],EFFECT[@JOINT]")
    first, second = (_rival(name, joints, modes, diagnosed) for name in names)
    if first.term == second.term:
        raise _refused("twice the same effect at the same joint", words, "two different hypotheses")
    return first, second


def _rival(
    word: str, joints: Sequence[str], modes: Sequence[str] | None, diagnosed: Diagnosed | None
) -> Rival:
    effect, _, joint = word.partition("@")
    law = catalogue().get(effect)
    if law is None or not law.candidate:
        known = [name for name, one in catalogue().items() if one.candidate]
        raise _refused("no effect of the catalogue", effect, suggest(effect, known))
    if law.family == "contact":
        raise _refused(
            "a motion within approved limits touches nothing, so no contact shows", effect,
            "an effect of the robot",
        )  # fmt: skip
    parameters = {} if diagnosed is None else diagnosed.parameters
    if law.scope == "robot":
        if joint:
            raise _refused("this effect is the whole robot's", word, effect)
        return Rival(Term(effect, -1), effect, parameters.get((effect, None), {}))
    if not joint:
        joint = _only_joint(effect, joints, diagnosed)
    if joint not in joints:
        raise _refused("no joint that may move", joint, suggest(joint, joints))
    at = list(joints).index(joint)
    if law.family in ("actuation", "timing"):
        mode = None if modes is None else modes[at]
        if mode is not None and mode not in law.modes:
            raise _refused(
                f"it cannot act under {mode} commands", word, f"{' or '.join(law.modes)} commands"
            )
    return Rival(Term(effect, at), f"{effect}@{joint}", parameters.get((effect, joint), {}))


def _only_joint(effect: str, joints: Sequence[str], diagnosed: Diagnosed | None) -> str:
    named = [] if diagnosed is None else list(diagnosed.joints.get(effect, ()))
    possible = [one for one in dict.fromkeys(named) if one in joints] or list(joints)
    if len(possible) > 1:
        raise _refused("at which joint?", effect, " or ".join(f"{effect}@{j}" for j in possible))
    return str(possible[0])


def _refused(problem: str, value: str, expected: str) -> SpecError:
    return SpecError(problem, where=_OPTION, value=value, expected=expected)


def fitted_values(rival: Hypothesis, scales: Scales, slides: Sequence[bool]) -> dict[str, Any]:
    """Parameters of a hypothesis with one term, as ``diagnosis.json`` writes them."""
    (term,) = rival.terms
    slide = bool(slides[max(term.joint, 0)])
    written: dict[str, Any] = {}
    has = term.law.has(rival.theta)
    for p, theta, present in zip(term.parameters, rival.theta, has, strict=True):
        if present:
            value = p.reported(float(theta) * scales.value(p, term.joint))
            unit = p.unit("slide" if slide else "hinge")
            written[p.reported_name] = {
                "value": float(f"{value:.6g}") if np.isfinite(value) else None, "unit": unit,
            }  # fmt: skip
    return written
