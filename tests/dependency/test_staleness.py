"""Staleness of goldens computed from parts, without model and files."""

from __future__ import annotations

import cProfile
import pstats

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_twin.dependency import Part, canonical
from pytest_twin.outcome import Reason
from pytest_twin.staleness import Baseline, DependencyMap, changes, staleness

KEY = "golden/a@mujoco"


def dependencies(**parts: float) -> DependencyMap:
    found = {name: Part(name, {"value": value}) for name, value in parts.items()}
    return DependencyMap(found, {KEY: frozenset(found)})


def baseline(of: DependencyMap, *, passed: bool = True) -> Baseline:
    return Baseline(3, of.parts, dict.fromkeys(of.depends_on, passed), of.depends_on)


def why(today: DependencyMap, before: Baseline | None) -> list[str]:
    return [str(reason) for reason in staleness(today, before)[KEY]]


def test_a_golden_with_unchanged_parts_is_fresh() -> None:
    assert why(dependencies(a=1, b=2), baseline(dependencies(a=1, b=2))) == []
    assert why(dependencies(a=0.1 + 0.2), baseline(dependencies(a=0.3))) == []


def test_each_reason_for_staleness_has_its_own_message() -> None:
    before = baseline(dependencies(a=1, b=2))
    assert why(dependencies(a=1, b=2), None) == ["no release yet"]
    assert why(dependencies(a=1, b=3), before) == ["b: value 2 -> 3"]
    assert why(dependencies(a=1), before) == ["b: dependency set changed: removed"]
    assert why(dependencies(a=1, b=2, c=0), before) == ["c: dependency set changed: added"]
    assert why(dependencies(a=1, b=2), baseline(dependencies(a=1, b=2), passed=False)) == [
        "failed in release 3"
    ]
    other = Baseline(3, before.parts, {}, {})
    assert why(dependencies(a=1), other) == ["not in release 3"]


def test_a_golden_that_depends_on_a_missing_part_is_always_stale() -> None:
    today = DependencyMap({}, {KEY: frozenset({"mujoco/frame:gone"})})
    assert why(today, baseline(today)) == ["mujoco/frame:gone: is missing"]


def test_a_golden_is_stale_if_the_release_lacks_one_of_its_parts() -> None:
    before = baseline(dependencies(a=1, b=2))
    torn = Baseline(3, {"a": before.parts["a"]}, before.passed, before.depended_on)
    assert staleness(dependencies(a=1, b=2), torn)[KEY] != ()


DIFFERENCES = [
    ({"mass [kg]": 0.5}, {"mass [kg]": 0.6}, ["mass 0.5 -> 0.6 kg"]),
    ({"com [m]": [0.0, 1.0]}, {"com [m]": [0.0, 2.0]}, ["com [0, 1] -> [0, 2] m"]),
    ({"on": True}, {"on": False}, ["on yes -> no"]),
    ({"range [rad]": None}, {"range [rad]": [-1.0, 1.0]}, ["range none -> [-1, 1] rad"]),
    ({}, {"offset [m]": 1.0}, ["offset absent -> 1 m"]),
    ({"offset [m]": 1.0}, {}, ["offset 1 -> absent"]),
    ({"geoms": []}, {"geoms": [{"name": "tip", "condim": 3}]}, ["geoms.tip.condim absent -> 3"]),
    (
        {"geoms": [{"name": "tip", "size [m]": 0.1}]},
        {"geoms": [{"name": "tip", "size [m]": 0.2}]},
        ["geoms.tip.size 0.1 -> 0.2 m"],
    ),
    ({"sha256": "a" * 64}, {"sha256": "b" * 64}, [f"sha256 {'a' * 12} -> {'b' * 12}"]),
]


@pytest.mark.parametrize(("old", "new", "words"), DIFFERENCES)
def test_differences_are_described_with_old_and_new_value_and_unit(
    old: dict,  # type: ignore[type-arg]
    new: dict,  # type: ignore[type-arg]
    words: list[str],
) -> None:
    found = [str(reason) for reason in changes(Part("p", old), Part("p", new))]
    assert [text.removeprefix("p: ") for text in found][: len(words)] == words


def test_further_differences_are_only_counted() -> None:
    old = Part("p", {str(i): 0 for i in range(10)})
    new = Part("p", {str(i): 1 for i in range(10)})
    assert len(changes(old, new)) == 5
    assert changes(old, new)[-1] == Reason("p", "and 6 more fields")


values = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.floats(-10, 10) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=10,
)
contents = st.dictionaries(st.text(max_size=3), values, max_size=4)


@given(contents, contents)
def test_a_golden_is_stale_exactly_if_the_content_of_a_part_differs(old: dict, new: dict) -> None:  # type: ignore[type-arg]
    today = DependencyMap({"p": Part("p", new)}, {KEY: frozenset({"p"})})
    before = Baseline(1, {"p": Part("p", old)}, {KEY: True}, today.depends_on)
    assert bool(staleness(today, before)[KEY]) == (canonical(old) != canonical(new))


def test_the_order_of_keys_does_not_change_the_digest() -> None:
    assert Part("p", {"a": 1, "b": 2}).digest == Part("p", {"b": 2, "a": 1}).digest


def test_a_non_finite_number_has_no_digest() -> None:
    with pytest.raises(ValueError, match="JSON"):
        _ = Part("p", {"a": float("nan")}).digest


def test_the_cost_of_staleness_is_linear_in_the_number_of_goldens() -> None:
    """Measured in function calls, which do not depend on the load of the machine."""

    def calls(count: int) -> int:
        parts = {f"p{i}": Part(f"p{i}", {"v": i}) for i in range(200 + count)}
        shared = {f"p{i}" for i in range(200)}
        depends_on = {f"g{i}@m": frozenset(shared | {f"p{200 + i}"}) for i in range(count)}
        before = Baseline(1, dict(parts), dict.fromkeys(depends_on, True), depends_on)
        parts["p0"] = Part("p0", {"v": -1})
        profile = cProfile.Profile()
        found = profile.runcall(staleness, DependencyMap(parts, depends_on), before)
        assert all(found.values())
        return int(pstats.Stats(profile).total_calls)

    # Quadratic cost would give a factor of 100.
    assert calls(10_000) < 11 * calls(1_000)
