"""The search depends on the declared traits of an effect, not on its id or its starting sizes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from searched import ProblemPhysics
from test_first_order import problem_of
from two_pendulums import case

import pytest_twin.diagnosis
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.limit_refinement import is_single_amplitude_limit
from pytest_twin.diagnosis.first_order.sensitivities import Sensitivity, starting_grid
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.search.proposed_starts import starts_at
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.effects import catalogue
from pytest_twin.effects.proposal import sizes_up_to_bound
from pytest_twin.estimation.hypothesis import EMPTY, Term
from pytest_twin.formats.mcap import TOPICS
from pytest_twin.loaded_model import load_model

DIAGNOSIS = Path(pytest_twin.diagnosis.__file__).parent
OTHER_MEANINGS = {
    # A key of recording metadata and of twin.yaml, and an attribute of MJCF joints.
    ("windows.py", "payload"),
    ("roles.py", "payload"),
    ("native.py", "payload"),
    ("native.py", "armature"),
    # The name of the rotor inertia in a note.
    ("physical_totals.py", "armature"),
    # A parameter of a servo in the library.
    ("servo_priors.py", "armature"),
}


def string_literals(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@pytest.mark.parametrize(
    "path", sorted(DIAGNOSIS.rglob("*.py")), ids=lambda p: str(p.relative_to(DIAGNOSIS))
)
def test_no_module_of_the_diagnosis_contains_the_id_of_an_effect(path: Path) -> None:
    named = {text for text in string_literals(path) if text in catalogue()}
    named = {text for text in named if (path.name, text) not in OTHER_MEANINGS}
    assert not named, "declare a trait in effects/base.py and use it instead of the id"


PACKAGE = """
import numpy as np

from pytest_twin.effects import Effect, Parameter, Start


class Brush(Effect):
    id = "effort_cogging"
    family = "friction"
    law = "effort = -coefficient v"
    source = "a test"
    parameters = (
        Parameter("coefficient", "damping", 0.0, 0.0, 99.0, (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)),
    )

    def force(self, world, values):
        world.applied -= values["coefficient"] * world.velocity


class Ceiling(Brush):
    id = "ceiling"
    is_limit = True
    parameters = (Parameter("coefficient", "damping", 0.0, 0.0, 99.0, (0.1, 0.2)),)


class Ripple(Brush):
    id = "ripple"
    periodic = True
    needs_effort_sensor = True


class Gear(Brush):
    id = "gear"

    def propose(self, at):
        if at.present is None and at.servo == "position":
            yield Start(np.array([2.9]), {"armature": {"inertia": 0.01}})
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a package with four effects."""
    info = tmp_path / "brushes-1.0.dist-info"
    info.mkdir()
    (tmp_path / "brushes.py").write_text(PACKAGE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: brushes\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[pytest_twin.effects]\neffort_cogging = brushes:Brush\nceiling = brushes:Ceiling\n"
        "ripple = brushes:Ripple\ngear = brushes:Gear\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    catalogue.cache_clear()
    yield
    monkeypatch.undo()
    catalogue.cache_clear()


def first_sensitivity(term: Term) -> Sensitivity:
    start, amplitude_indices = starting_grid(term)[0]
    return Sensitivity(term, start, amplitude_indices, np.zeros((1, 1, 1)))


@pytest.mark.usefixtures("installed")
def test_six_starting_sizes_do_not_make_an_effect_a_limit() -> None:
    term = Term("effort_cogging", 0)
    assert len(term.parameters[0].starts) == 6
    assert sizes_up_to_bound(term.law) == []
    assert not is_single_amplitude_limit(first_sensitivity(term))
    assert term.dry_level is None
    assert not term.law.nearly_linear


@pytest.mark.usefixtures("installed")
def test_a_declared_limit_needs_only_two_starting_sizes() -> None:
    term = Term("ceiling", 0)
    assert is_single_amplitude_limit(first_sensitivity(term))
    sizes = [float(s[0]) for s in sizes_up_to_bound(term.law)]
    assert sizes == pytest.approx([0.2 * 2.0**k for k in range(1, 9)])
    assert max(sizes) <= 99.0


@pytest.mark.usefixtures("installed")
def test_the_search_simulates_starts_that_an_installed_effect_proposes() -> None:
    gear, armature = Term("gear", 1), Term("armature", 1)
    problem = problem_of("position", {Term("viscous_friction", 1): {"coefficient": 3.0}})
    (start,) = starts_at(problem, EMPTY, gear)
    assert start.parameters == pytest.approx([2.9])
    assert starts_at(problem, EMPTY, Term("effort_cogging", 1)) == []
    assert starts_at(problem, EMPTY.with_term(gear, np.array([2.0])), gear) == []
    starts = ProblemPhysics(problem).starts(EMPTY, np.ones(2, dtype=bool))
    both = next(h for _, h in starts if gear in h.terms)
    assert set(both.terms) == {gear, armature}
    assert both.theta[both.slice_of(gear)] == pytest.approx([2.9])
    assert both.theta[both.slice_of(armature)] == pytest.approx([0.01])


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("measured", [False, True], ids=["no effort sensor", "effort sensor"])
def test_candidates_are_effects_that_the_recordings_can_contain(
    measured: bool, tmp_path: Path
) -> None:
    words = case(tmp_path / "case")
    realization = load_model(Path(words[0])).realization
    trials = read_trials([Path(w) for w in words[1:]], [], TOPICS, realization.structure)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    problem = replace(problem, effort_floor=np.ones(2) if measured else None)
    problem.simulator.layout.slides = np.array([False, True])
    found = candidates(problem)
    assert [t.joint for t in found if t.effect == "effort_cogging"] == [0, 1]
    assert [t.joint for t in found if t.effect == "ripple"] == ([0] if measured else [])
