"""The one-line quick diagnosis: likely effects, or where and when a force is missing."""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.quick_diagnosis import QuickDiagnosis
from pytest_twin.report.quick_diagnosis import quick_diagnosis_in_words

WHERE = TimeAndRegime(
    "fast, |velocity| > 3 rad/s", {"a.mcap": [[0.5, 0.75], [2.0, 3.25], [4.0, 4.5]]}
)


STICTION = LikelyEffect(
    ("stribeck_friction", ("elbow",)),
    {"coulomb": (0.3312, "N*m"), "stribeck_velocity": (0.0512, "rad/s"), "viscous": (0.0, "1")},
    0.655,
    0.9996,
)
DELAY = LikelyEffect(
    ("command_delay", ("wrist", "hand")),
    {"delay": (0.02, "s")},
    0.9,
    0.95,
    explained_joints=("wrist", "hand"),
)


def said(
    *likely_effects: LikelyEffect,
    unexplained: tuple[str, ...] = (),
    joint: str | None = "elbow",
    floors: float = 5.04,
) -> str:
    seen = QuickDiagnosis(likely_effects, unexplained, joint, WHERE, floors)
    return quick_diagnosis_in_words(seen)


def test_one_likely_effect_is_stated_with_size_confidence_and_gain() -> None:
    assert said(STICTION) == (
        "probably Stribeck friction at joint elbow: Coulomb friction about 0.33 N*m, Stribeck "
        "velocity about 0.051 rad/s; confidence 65 %; correcting it would remove 99 % of the "
        "squared error"
    )


def test_equally_likely_effects_are_all_named() -> None:
    rivals = (("presliding_hysteresis", ("elbow",)), ("sensor_delay", ()))
    assert said(replace(STICTION, alternatives=rivals)) == (
        "could be Stribeck friction at joint elbow (Coulomb friction about 0.33 N*m, Stribeck "
        "velocity about 0.051 rad/s), presliding hysteresis at joint elbow or sensor delay; "
        "correcting the first would remove 99 % of the squared error"
    )


def test_different_effects_on_different_joints_are_each_named() -> None:
    assert said(replace(STICTION, explained_joints=("elbow",)), DELAY, unexplained=("lift",)) == (
        "probably Stribeck friction at joint elbow: Coulomb friction about 0.33 N*m, Stribeck "
        "velocity about 0.051 rad/s; confidence 65 %; correcting it would remove 99 % of the "
        "squared error of elbow; probably command delay at joint wrist and hand: command delay "
        "about 20 ms; confidence 90 %; correcting it would remove 95 % of the squared error of "
        "wrist and hand; no known effect explains the error of lift"
    )


def test_without_a_likely_effect_joint_and_times_of_the_missing_force_are_stated() -> None:
    assert said() == (
        "no known effect explains the error; a force is missing at joint elbow, mainly fast, "
        "|velocity| > 3 rad/s, 2 to 3.25 s, 4 to 4.5 s"
    )
    assert said(joint=None) == (
        "no known effect explains the error, and no joint shows a missing force above the noise; "
        "the error is 5 times the noise floor; mainly fast, |velocity| > 3 rad/s, 2 to 3.25 s, "
        "4 to 4.5 s"
    )


def test_an_error_within_the_noise_has_no_cause() -> None:
    assert said(floors=1.04) == "the error is within the noise (1 noise floors)"


def test_joint_names_cannot_inject_escape_sequences() -> None:
    assert said(joint="el\x1bbow\n").isprintable()
