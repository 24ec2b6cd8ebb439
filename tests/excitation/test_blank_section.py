"""The section ``excitation:`` that ``init`` writes as comments: limits are never invented."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from approved_arms import ARM

from pytest_twin import cli
from pytest_twin.excitation.template import blank_section
from pytest_twin.realization.loading import load
from pytest_twin.setup.writing import FirstTwin, write_twin_file

pytestmark = pytest.mark.usefixtures("commands_in_process")


def first_twin(folder: Path, model: str = ARM) -> Path:
    path = folder / "arm.xml"
    path.write_text(model)
    first = FirstTwin("arm", path, [], {}, None, {}, {}, {}, excitation=blank_section(load(path)))
    return write_twin_file(folder, first)


def uncommented(twin: Path) -> str:
    """Take the # off the lines of the section."""
    lines = twin.read_text().splitlines()
    start = lines.index("# excitation:")
    stop = next(i for i in range(start, len(lines)) if "    plan:" in lines[i]) + 1
    lines[start:stop] = [line.removeprefix("# ") for line in lines[start:stop]]
    return "\n".join(lines) + "\n"


def test_the_section_is_a_comment_with_the_limits_of_the_model_and_the_command(
    tmp_path: Path,
) -> None:
    twin = first_twin(tmp_path)
    assert "excitation" not in yaml.safe_load(twin.read_text())
    text = twin.read_text()
    assert "# pytest-twin excite twin.yaml --check --out check" in text
    assert "the model: -2 to 2" in text
    assert "the model: at most 20" in text


def test_without_the_hashes_every_value_is_blank(tmp_path: Path) -> None:
    section = yaml.safe_load(uncommented(first_twin(tmp_path)))["excitation"]

    def values(node: object) -> list[object]:
        return [v for one in node.values() for v in values(one)] if isinstance(node, dict) else [
            node
        ]  # fmt: skip

    assert set(section["joints"]) == {"lift", "elbow"}
    assert set(values(section)) == {None}


@pytest.mark.parametrize("is_uncommented", [False, True])
def test_the_check_prints_the_section_and_exits_2_until_it_is_filled_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], is_uncommented: bool
) -> None:
    twin = first_twin(tmp_path)
    if is_uncommented:
        twin.write_text(uncommented(twin))
    out = tmp_path / "check"
    assert cli.main(["excite", str(twin), "--check", "--out", str(out)]) == 2
    printed, error = capsys.readouterr()
    assert "excitation:" in printed
    assert "approved_by" in error
    assert not (out / "excitation.json").exists()


@pytest.mark.parametrize(
    "body",
    [
        '<body><geom size=".1" mass="1"/></body>',
        '<body><freejoint/><geom size=".1" mass="1"/><body pos=".2 0 0"><joint name="leg"/>'
        '<geom size=".05" mass=".2"/></body></body>',
    ],
)
def test_a_robot_for_which_no_motion_can_be_designed_has_no_section(
    tmp_path: Path, body: str
) -> None:
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert blank_section(load(tmp_path / "robot.xml")) == ""
