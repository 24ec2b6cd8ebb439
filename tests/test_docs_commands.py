"""Every command that README and the docs print runs as printed, or a comment says why not.

A block of commands is a fence with the language ``sh``. The comment ``<!-- not run: REASON -->``
before a block, or ``<!-- not run on this page: REASON -->``, exempts it from running; its
``pytest-twin`` commands must still be accepted by the parser.
"""

from __future__ import annotations

import csv
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from in_process import forked_pytest

from pytest_twin import cli

ROOT = Path(__file__).parents[1]
sys.path += [str(ROOT / "tests" / room) for room in ("audit", "calibration")]

from audited import robots  # noqa: E402
from test_calibrate_command import write_cell  # noqa: E402

PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if "generated" not in p.parts),
]
EXAMPLE = ROOT / "examples" / "carriage"
MAINTENANCE = ROOT / "examples" / "maintenance"
CARRIAGE_DIAGNOSIS = (
    "pytest-twin diagnose twin.yaml recordings/sweep.csv recordings/steps.csv "
    "--held-out recordings/moves.csv --out why"
)
"""On two pages, of the same files; it takes 13 s."""
FENCE = re.compile(
    r"(?P<comments>(?:^<!--[^\n]*-->\n)*)^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
PROGRAM = re.compile(r"^(\$ |(pytest|pytest-twin|pip|python3?|sphinx-build) (?! ))", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """One fence of a page.

    Attributes:
        page: path of the page, relative to the repository.
        line: line of the fence.
        language: of the fence; ``sh`` for commands.
        text: what is in it.
        reason: why its commands are not run, or None.
    """

    page: str
    line: int
    language: str
    text: str
    reason: str | None

    @property
    def commands(self) -> list[str]:
        lines = self.text.replace("\\\n", " ").splitlines()
        return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def blocks_of(page: Path) -> Iterator[Block]:
    text = page.read_text("utf-8")
    whole = re.search(r"<!-- not run on this page: (.+) -->", text)
    for fence in FENCE.finditer(text):
        one = re.search(r"<!-- not run: (.+) -->", fence["comments"]) or whole
        yield Block(
            page.relative_to(ROOT).as_posix(),
            text.count("\n", 0, fence.start("language")) + 1,
            fence["language"],
            fence["text"],
            one and one[1],
        )


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
SHELL = [block for block in BLOCKS if block.language == "sh"]


def test_every_command_is_in_a_block_of_commands() -> None:
    elsewhere = [
        f"{b.page}:{b.line}" for b in BLOCKS if b.language != "sh" and PROGRAM.search(b.text)
    ]
    assert elsewhere == []


@pytest.mark.parametrize(
    "block", [pytest.param(b, id=f"{b.page}:{b.line}") for b in SHELL if b.reason]
)
def test_the_reason_why_a_block_is_not_run(block: Block) -> None:
    pytest.skip(str(block.reason))


def test_the_parser_accepts_every_printed_command(capsys: pytest.CaptureFixture[str]) -> None:
    refused = []
    for block in SHELL:
        for line in block.commands:
            for words in _simple_commands(line):
                if words[:1] != ["pytest-twin"]:
                    continue
                try:
                    cli.parser((words[1],)).parse_args(words[1:])
                except SystemExit:
                    refused.append(f"{block.page}:{block.line}: {capsys.readouterr().err}")
    assert refused == []


def test_commands_within_a_sentence_name_existing_commands_and_options() -> None:
    for page in PAGES:
        text = re.sub(FENCE, "", page.read_text("utf-8"))
        for span in re.findall(r"`(pytest-twin\s[^`]+)`", text):
            words = span.split()[1:]
            if not words[0].islower() or words[0].startswith("-"):
                continue
            assert words[0] in cli.COMMANDS, f"{page.name}: {span}"
            command = cli.parser((words[0],))._subparsers._group_actions[0].choices[words[0]]
            options = {option for action in command._actions for option in action.option_strings}
            for option in re.findall(r"(?<!\S)\[?(--?[a-z][a-z-]*)", span):
                assert option in options, f"{page.name}: {span}"


def _simple_commands(line: str) -> list[list[str]]:
    """The words of each command of a line, without comments."""
    words = shlex.split(line.strip("()"), comments=True)
    commands: list[list[str]] = [[]]
    for word in words:
        if word == "&&":
            commands.append([])
        else:
            commands[-1].append(word)
    return commands


_DIAGNOSED: dict[str, tuple[Path, int, str]] = {}
"""Diagnosis that two pages print -> folder that it wrote, exit status and output."""


class Reader:
    """Somebody who types the commands of a page, in a folder of his own."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capture = capfd
        self._environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PYTEST_ADDOPTS": "-p no:cacheprovider -p no:hypothesispytest -p no:xdist",
        }

    def types(self, line: str) -> tuple[int, str]:
        """Run one line; return the exit status of its last command, and all output."""
        self._capture.readouterr()
        status = 0
        for words in _simple_commands(line):
            if words[0] == "cd":
                self.folder = (self.folder / words[1]).resolve()
            elif line in _DIAGNOSED:
                written, status, text = _DIAGNOSED[line]
                shutil.copytree(written, self.folder / written.name)
                return status, text
            elif words[0] == "pytest-twin":
                with pytest.MonkeyPatch.context() as patch:
                    patch.chdir(self.folder)
                    status = cli.main([w for word in words[1:] for w in self._expanded(word)])
            elif words[0] == "pytest":
                done = forked_pytest(*words[1:], cwd=self.folder, env=self._environment)
                status = done.returncode
                sys.stdout.write(done.stdout + done.stderr)
            else:
                status = subprocess.run(words, cwd=self.folder, env=self._environment).returncode
            if status:
                break
        out, err = self._capture.readouterr()
        if line == CARRIAGE_DIAGNOSIS:
            _DIAGNOSED[line] = self.folder / "why", status, out + err
        return status, out + err

    def _expanded(self, word: str) -> list[str]:
        """The files that a shell puts in the place of a pattern."""
        if "*" not in word:
            return [word]
        return sorted(str(path.relative_to(self.folder)) for path in self.folder.glob(word))

    def follows(
        self, page: str, *, blocks: slice = slice(None), fails: tuple[str, ...] = ()
    ) -> list[str]:
        """Run blocks of a page in order; return the output of each.

        Args:
            page: path of the page.
            blocks: those of the page's blocks that are run.
            fails: commands that end with status 1, in order.
        """
        expected_failures = list(fails)
        outputs = []
        for block in [b for b in SHELL if b.page == page and b.reason is None][blocks]:
            output = ""
            for line in block.commands:
                status, text = self.types(line)
                output += text
                command = shlex.join(_simple_commands(line)[-1])
                if status == 1 and expected_failures[:1] == [command]:
                    expected_failures.pop(0)
                    status = 0
                assert status == 0, f"{page}:{block.line}: {line}\n{text}"
            outputs.append(output)
        assert expected_failures == []
        return outputs


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty home folder."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    return tmp_path / "home"


@pytest.fixture
def reader(
    home: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], commands_in_process: None
) -> Reader:
    (tmp_path / "reader").mkdir()
    return Reader(tmp_path / "reader", capfd)


LINK = """\
  <link name="{name}">
    <inertial>
      <origin xyz="0.1 0 0"/><mass value="0.5"/>
      <inertia ixx="{ixx}" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.04 0.04"/></geometry></collision>
  </link>
"""
JOINT = """\
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="3"/>
  </joint>
"""


def urdf(ixx: float = 2e-4) -> str:
    """An arm with joints shoulder and wrist; ``ixx`` above 2e-3 is an impossible inertia."""
    return (
        '<robot name="arm">\n  <link name="base"/>\n'
        + LINK.format(name="link2", ixx=2e-4)
        + LINK.format(name="link3", ixx=ixx)
        + JOINT.format(name="shoulder", parent="base", child="link2", x=0)
        + JOINT.format(name="wrist", parent="link2", child="link3", x=0.2)
        + "</robot>\n"
    )


SRDF = """\
<robot name="arm">
  <group name="all"><chain base_link="base" tip_link="link3"/></group>
  <group_state name="home" group="all"><joint name="shoulder" value="0"/></group_state>
</robot>
"""


def supplier(folder: Path) -> None:
    """``supplier.zip``: a URDF with one impossible inertia, and its SRDF."""
    source = folder / "made" / "arm"
    for name, text in (("urdf/arm.urdf", urdf(1e-2)), ("srdf/arm.srdf", SRDF)):
        (source / name).parent.mkdir(parents=True)
        (source / name).write_text(text)
    shutil.make_archive(str(folder / "supplier"), "zip", source)
    shutil.rmtree(folder / "made")


def resting_arm(folder: Path, *recordings: str) -> None:
    """``arm.urdf``, and recordings of it at rest under zero efforts."""
    (folder / "arm.urdf").write_text(urdf())
    for name in recordings:
        with (folder / "rest.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            joints = ("shoulder", "wrist")
            writer.writerow(
                ["time", *(f"{j}.{c}" for c in ("position", "command") for j in joints)]
            )
            writer.writerows([f"{0.01 * k:.2f}", 0, 0, 0, 0] for k in range(100))
        words = ["convert", str(folder / "rest.csv"), "--out", str(folder / name)]
        assert cli.main([*words, "--command-mode", "effort"]) == 0
    (folder / "rest.csv").unlink(missing_ok=True)


def printed(page: str, language: str) -> list[str]:
    """The other blocks of a page with one language."""
    return [b.text for b in BLOCKS if b.page == page and b.language == language]


NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def assert_printed(text: str, output: str) -> None:
    """Check that ``output`` contains ``text`` up to line breaks and to 2 % of each number."""
    text, output = " ".join(text.split()), " ".join(output.split())
    pattern = NUMBER.sub("#", text)
    start = NUMBER.sub("#", output).find(pattern)
    assert start >= 0, f"{text}\n\nnot in\n\n{output}"
    first = NUMBER.sub("#", output)[:start].count("#")
    numbers = [float(n) for n in NUMBER.findall(text)]
    shown = [float(n) for n in NUMBER.findall(output)][first:][: len(numbers)]
    assert shown == pytest.approx(numbers, rel=0.02)


def test_readme(reader: Reader) -> None:
    """The example fails, is diagnosed, and passes; a new robot is released and verified."""
    start = reader.folder
    reader.folder = start / "checkout"
    ignored = shutil.ignore_patterns(".twin", "__pycache__")
    shutil.copytree(EXAMPLE, reader.folder / "examples" / "carriage", ignore=ignored)
    outputs = reader.follows("README.md", blocks=slice(3), fails=("pytest",))
    for text, output in zip(printed("README.md", "text"), outputs, strict=False):
        assert_printed(text, output)
    reader.folder = start / "robot"
    reader.folder.mkdir()
    (reader.folder / "my_robot.urdf").write_text(urdf())
    reader.follows("README.md", blocks=slice(3, None))


def test_from_a_log_to_a_patched_model(reader: Reader) -> None:
    page = "docs/tutorials/log_to_model.md"
    start = reader.folder
    reader.folder = start / "checkout"
    shutil.copytree(
        EXAMPLE, reader.folder / "examples" / "carriage", ignore=shutil.ignore_patterns(".twin")
    )
    outputs = reader.follows(page, fails=("pytest",))
    for text, output in zip(printed(page, "text")[1:], outputs[1:], strict=True):
        assert_printed(text, output)


@pytest.mark.nightly
def test_a_machine_that_wears(reader: Reader) -> None:
    """The tutorial: sign a release, find the wear, then repair the machine or change the model."""
    page = "docs/tutorials/worn_machine.md"
    start = reader.folder
    reader.folder = start / "checkout"
    shutil.copytree(MAINTENANCE, reader.folder / "examples" / "maintenance")
    worn = "pytest-twin diagnose twin.yaml recordings/june.csv --before 'recordings/may_*.csv' "
    outputs = reader.follows(page, fails=(worn + "--out changes",))
    _, check, changed, repaired = printed(page, "text")
    for text, output in zip(
        (check, changed, repaired), (outputs[1], outputs[4], outputs[5]), strict=True
    ):
        assert_printed(text, output)
    assert "release 0001 signed" in outputs[3]
    assert "release 0002 signed" in outputs[6]


def test_first_release_rollback_and_stamps(reader: Reader) -> None:
    """The first tutorial, then going back to its first release, stamps and a budget."""
    page = "docs/tutorials/first_release.md"
    (reader.folder / "arm.xml").write_text(printed(page, "xml")[0])
    verdict, proposals, release, *_ = reader.follows(page, fails=("pytest",))
    assert_printed(printed(page, "text")[0].partition("...")[0], verdict)
    assert "next: pytest --twin-release" in proposals
    assert "release 0001 signed" in release
    reader.follows("docs/release.md")
    (reader.folder / "data").mkdir()
    rest = reader.folder / "rest.csv"
    rows = "".join(f"0.{k},0,0\n" for k in range(9))
    rest.write_text(f"time,elbow.position,elbow.command\n{rows}")
    assert cli.main(["convert", str(rest), "--out", str(reader.folder / "data" / "d.mcap")]) == 0
    reader.follows("docs/stamps.md")
    reader.follows("docs/budget.md")


@pytest.mark.parametrize("page", ["docs/how-to/supplier_robot.md", "docs/asset.md"])
def test_the_robot_of_a_supplier(page: str, reader: Reader) -> None:
    supplier(reader.folder)
    (reader.folder / "allegro.urdf").symlink_to(
        robots() / "allegro_hand_description" / "urdf" / "allegro_right_hand.urdf"
    )
    realize = "pytest-twin realize arm/source/urdf/arm.urdf --out arm"
    audit = "pytest-twin audit arm/source/urdf/arm.urdf"
    reader.follows(page, fails=(audit, realize) if "how-to" in page else (realize,))


def test_audits(reader: Reader) -> None:
    folder = reader.folder
    config = folder / "panda_moveit_config" / "config"
    config.mkdir(parents=True)
    for place, name in ((folder, "robot"), (folder, "arm"), (config, "panda")):
        (place / f"{name}.urdf").write_text(urdf().replace('"arm"', f'"{name}"'))
        (place / f"{name}.srdf").write_text(SRDF.replace('"arm"', f'"{name}"'))
    (folder / "evidence.yaml").write_text("schema: 1\n")
    reader.follows("docs/audit.md")


def test_recordings_and_effects(reader: Reader) -> None:
    for name in ("twin.yaml", "axis.xml"):
        shutil.copy(EXAMPLE / name, reader.folder)
    shutil.copy(EXAMPLE / "recordings" / "moves.csv", reader.folder / "log.csv")
    log, moves = (str(reader.folder / name) for name in ("log.csv", "moves.mcap"))
    assert cli.main(["convert", log, "--out", moves]) == 0
    reader.follows("docs/how-to/view_replay.md")
    reader.follows("docs/how-to/recordings.md")
    reader.follows("docs/effects.md")


def test_a_cell_is_calibrated(reader: Reader) -> None:
    write_cell(reader.folder)
    reader.follows("docs/calibration.md")


def test_a_recording_becomes_a_test(reader: Reader) -> None:
    page = "docs/how-to/replay_golden.md"
    resting_arm(reader.folder, "pick.mcap", "place.mcap")
    reader.follows(page, blocks=slice(1))
    spec = reader.folder / "golden" / "replay" / "moves.yaml"
    spec.write_text(printed(page, "yaml")[0].replace("recordings/pick.mcap", "pick.mcap"))
    reader.follows(page, blocks=slice(1, None))


def test_every_page_with_commands_is_followed() -> None:
    """A new page of commands needs a test here, or a reason."""
    pages = {block.page for block in SHELL if block.reason is None}
    code = Path(__file__).read_text("utf-8")
    assert [page for page in sorted(pages) if f'"{page}"' not in code] == []
