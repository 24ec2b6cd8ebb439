"""The one line of a first look: a name with its doubts, or where and when force is missing."""

from __future__ import annotations

from pytest_twin.diagnosis.glance import Glance, Suspect
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.locate import Where
from pytest_twin.report.glance import glance_words

WHERE = Where("fast, |velocity| > 3 rad/s", {"a.mcap": [[0.5, 0.75], [2.0, 3.25], [4.0, 4.5]]})


def test_a_name_comes_with_size_doubt_and_what_it_buys() -> None:
    values = {"coulomb": (0.3312, "N*m"), "stribeck_velocity": (0.0512, "rad/s")}
    rivals = (("presliding_hysteresis", "elbow"), ("sensor_delay", None))
    suspect = Suspect(Term("stribeck_friction", 1), "elbow", values, 0.655, 0.9996, rivals)
    assert glance_words(Glance(suspect, "elbow", WHERE, 40.0)) == (
        "probably Stribeck friction at joint elbow: Coulomb friction about 0.33 N*m, Stribeck "
        "velocity about 0.051 rad/s; confidence 65 %, it could also be presliding hysteresis at "
        "joint elbow or sensor delay; correcting it would remove 99 % of the squared error"
    )


def test_of_some_joints_alone_it_says_of_which() -> None:
    values = {"delay": (0.02, "s")}
    suspect = Suspect(Term("command_delay", 1), "elbow", values, 0.9, 0.95, of=("elbow", "wrist"))
    assert glance_words(Glance(suspect, "elbow", WHERE, 40.0)) == (
        "probably command delay at joint elbow: command delay about 20 ms; confidence 90 %; "
        "correcting it would remove 95 % of the squared error of elbow and wrist"
    )


def test_without_a_name_it_says_where_and_when() -> None:
    assert glance_words(Glance(None, "elbow", WHERE, 40.0)) == (
        "no known effect explains the error; a force is missing at joint elbow, mainly fast, "
        "|velocity| > 3 rad/s, 2 to 3.25 s, 4 to 4.5 s"
    )
    assert glance_words(Glance(None, None, WHERE, 2.04)) == (
        "no known effect explains the error, and no joint shows a missing force above the noise; "
        "the error is 2 times the noise floor; mainly fast, |velocity| > 3 rad/s, 2 to 3.25 s, "
        "4 to 4.5 s"
    )


def test_names_of_files_carry_no_escapes() -> None:
    said = glance_words(Glance(None, "el\x1bbow\n", WHERE, 40.0))
    assert said.isprintable()
