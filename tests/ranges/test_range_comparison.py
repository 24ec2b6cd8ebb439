"""Comparison of given randomization ranges with the measured ones."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parent))

from ranges_files import covariance, make_twin, record

from pytest_twin.errors import FormatError
from pytest_twin.ranges.ranges_of_twin import ranges_of_file

ISAAC = """
from somewhere import mdp
open("{marker}", "w").write("run")
class Events:
    friction = EventTerm(
        func=mdp.randomize_joint_parameters, mode="startup",
        params={{"asset_cfg": SceneEntityCfg("robot", joint_names=["elb.*"]),
                "friction_distribution_params": (0.0, 1.8), "operation": "abs"}},
    )
    mass = EventTerm(
        func=mdp.randomize_rigid_body_mass, mode="startup",
        params={{"asset_cfg": SceneEntityCfg("robot", body_names="fore"),
                "mass_distribution_params": (0.9, 1.1), "operation": "scale"}},
    )
    push = EventTerm(func=mdp.push_by_setting_velocity, mode="interval", params={{}})
"""


def comparison(folder: Path, given: Path, more: str = "") -> dict[str, Any]:
    twin = make_twin(folder, [record(covariance())], more)
    found = ranges_of_file(str(twin), {"against": str(given)})["against"]
    assert isinstance(found, dict)
    return {**found, "by": {one["parameter"]: one for one in found["entries"]}}


def test_ranges_are_read_from_isaac_lab_events_without_running_the_file(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    given = tmp_path / "events.py"
    given.write_text(ISAAC.format(marker=marker))
    found = comparison(tmp_path / "twin", given)
    assert not marker.exists()
    assert set(found["by"]) == {"elbow.coulomb_friction", "elbow.viscous_friction", "fore.mass"}
    dry = found["by"]["elbow.coulomb_friction"]
    # 1.8 N*m against 2 * 1.96 * 0.05 N*m.
    assert dry["times"] == pytest.approx(9.2, abs=0.1)
    assert "the given range 0 to 1.8 N*m is 9.2 times as wide as what was measured" in dry["words"]
    assert found["by"]["fore.mass"]["given"] == pytest.approx([0.9, 1.1])
    assert found["not_read"] == ["line 15: push_by_setting_velocity sets nothing that the ranges "
                                 "have"]  # fmt: skip
    assert any(line.startswith("elbow.armature, measured 0.03") for line in found["not_given"])


def test_a_measured_value_outside_the_given_range_is_reported_with_its_temperature(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "twin"
    folder.mkdir()
    for name, value in (("cold", 0.18), ("warm", 0.32)):
        one = record(covariance(0.2), name)
        one["parameters"]["elbow.coulomb_friction"]["value"] = value
        (folder / f"{name}.json").write_text(json.dumps(one))
    more = "ranges:\n  trials:\n  - {file: cold.json, temperature: 20}\n"
    more += "  - {file: warm.json, temperature: 40}\n"
    given = tmp_path / "given.yaml"
    given.write_text("elbow.coulomb_friction: [0.15, 0.25]\nelbow.colour: [1, 2]\n")
    found = comparison(folder, given, more)
    words = found["by"]["elbow.coulomb_friction"]["words"]
    assert " % of it, and what was measured at 40 deg C (0.32 N*m)" in words
    assert "at 20 deg C" not in words
    assert found["by"]["elbow.coulomb_friction"]["inside"] < 0.5
    assert found["not_read"] == ["elbow.colour: nothing measured it"]


def test_a_gaussian_distribution_of_a_scale_is_converted_to_a_range(tmp_path: Path) -> None:
    given = tmp_path / "events.yaml"
    given.write_text(
        "events:\n  a:\n    func: mjlab.envs.mdp.dr:joint_damping\n    params:\n"
        "      asset_cfg: {joint_names: [elbow]}\n      ranges: [1.0, 0.1]\n"
        "      operation: scale\n      distribution: gaussian\n"
    )
    (entry,) = comparison(tmp_path / "twin", given)["entries"]
    assert entry["given"] == pytest.approx([0.5 - 0.098, 0.5 + 0.098], abs=1e-3)


def test_the_written_ranges_compare_as_equally_wide(tmp_path: Path) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    (tmp_path / "ranges.json").write_text(json.dumps(ranges_of_file(str(twin))))
    found = comparison(tmp_path, tmp_path / "ranges.json")
    assert all(one["times"] == pytest.approx(1.0) for one in found["entries"])
    assert found["not_given"] == []


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.py", "def (", "not Python"),
        ("a.py", "x = 1", "it states no range that can be compared"),
        ("a.json", "[1, 2]", "no table of ranges"),
        ("a.json", "{", "not JSON"),
        ("a.yaml", "elbow.armature: [0.1, .inf]\n", "is not a finite number"),
        ("a.json", '{"elbow.armature": [2, 1]}',
         "elbow.armature: its lower end 2 is above its upper end 1"),
        ("a.yaml", "e: {func: joint_damping, params: {ranges: [3, 0.5]}}\n",
         "e: joint_damping: ranges: its lower end 3 is above its upper end 0.5"),
        ("a.toml", "", "not a type of file that can be compared"),
        ("a.yaml", "e: {func: joint_damping, params: {ranges: [0, 1], asset_cfg: {joint_names: "
         "'(a|aa)*b'}}}\n", "a pattern of names that is too complex to evaluate safely"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_compared_is_refused_with_a_reason(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError) as error:
        comparison(tmp_path / "twin", tmp_path / name)
    assert words in str(error.value)
    assert str(tmp_path / name) in str(error.value)
