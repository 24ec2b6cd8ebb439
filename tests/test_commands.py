"""The command line of ``pytest-twin``: help, one-line errors, JSON results, completion."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema

GOLDEN = Path(__file__).parents[1] / "golden"
CARRIAGE = Path(__file__).parents[1] / "examples" / "carriage"
LOADED = """
import sys
from pytest_twin import cli
try:
    cli.main([sys.argv[1], "--help"])
except SystemExit as end:
    assert end.code == 0
loaded = {name for name in cli.COMMANDS if cli.module_of(name) in sys.modules}
print("\\n" + " ".join(loaded))
"""


def test_the_first_page_of_the_help_imports_no_command() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOADED.replace("[sys.argv[1], ", "["), ""],
        capture_output=True, text=True, check=True, timeout=100,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == ""


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    for title, names in cli.GROUPS.items():
        group = said.partition(f"\n{title}:\n")[2].partition("\n\n")[0]
        assert re.findall(r"^  ([a-z-]+)\s", group, re.MULTILINE) == list(names)


def test_effects_describes_the_named_effects(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", "backlash"]) == 0
    text = capsys.readouterr().out
    assert "  gap [rad or m]: backlash; absent at 0; fitted within: 0 to 0.4\n" in text
    for part in ("law:\n  effort = ", "  dead_zone: move the link by hand", "source: Nordin"):
        assert part in text
    assert cli.main(["effects", "backlash", "payload", "--json", "-"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == ["backlash", "payload"]


def test_an_unknown_effect_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", "baklash"]) == 2
    assert capsys.readouterr().err == (
        "pytest-twin effects: there is no effect 'baklash'; did you mean 'backlash'? "
        "(expected a name from the list of pytest-twin effects)\n"
    )


def test_all_commands_name_twin_and_release_in_one_way() -> None:
    described: dict[str, set[str]] = {}
    for name, command in cli.parser()._subparsers._group_actions[0].choices.items():
        for action in command._actions:
            words = {"TWIN", "RELEASE"} & set(str(action.metavar).split("|"))
            if "twin" in action.dest or "release" in action.dest:
                assert words, f"{name}: {action.metavar}"
            for word in words:
                described.setdefault(word, set()).add(action.help.split(" (")[0].split(":")[0])
    assert described["TWIN"] == {"twin.yaml or its folder"}
    assert {
        text.removesuffix(" and its records; or a stamped data set or policy")
        for text in described["RELEASE"]
    } == {"folder of a release, or of a twin for its newest release"}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_a_command_states_purpose_example_and_exit_statuses(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main([name, "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    module = importlib.import_module(cli.module_of(name))
    assert re.search(rf"^examples?:\n(  .*\n)*  .*pytest-twin {name} ", said, re.MULTILINE)
    statuses = re.findall(r"^  (\d)  \w", said[said.index("exit status:") :], re.MULTILINE)
    assert statuses == [str(status) for status in sorted({*module.EXIT_STATUS, 2})]
    assert "." not in cli.COMMANDS[name].replace(".yaml", "")


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_examples_in_the_help_use_existing_options(name: str) -> None:
    """The parser must accept every documented example."""
    module = importlib.import_module(cli.module_of(name))
    for line in module.EXAMPLES:
        found = re.search(rf"pytest-twin {name} [^|>#)\"]*", line)
        if found is None:
            continue
        words = found[0].replace("'", "").split()[1:]
        args, unknown = cli.parser((name,)).parse_known_args(words)
        assert args.command == name
        assert [word for word in unknown if word.startswith("-")] == []


def test_a_misspelt_command_is_refused_with_a_similar_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["diagnoze"])
    assert end.value.code == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(
        "pytest-twin: there is no command 'diagnoze'; did you mean 'diagnose'? (commands: intake, "
    )
    assert all(name in said for name in cli.COMMANDS)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["audit", "arm.urdf", "--evidnce", "notes.yaml"],
            "pytest-twin audit: there is no option or argument '--evidnce'; did you mean "
            "'--evidence'?; see pytest-twin audit --help",
        ),
        (
            ["replay", "model.xml"],
            "pytest-twin replay: the following arguments are required: RECORDING, --out; "
            "see pytest-twin replay --help",
        ),
        (
            ["completion", "csh"],
            "pytest-twin completion: argument SHELL: invalid choice: 'csh' (choose from 'bash', "
            "'zsh', 'fish'); see pytest-twin completion --help",
        ),
        (
            ["audit", "--json", "arm.urdf"],
            "pytest-twin audit: argument --json: 'arm.urdf' is not a name of a JSON file (expected "
            "FILE.json, or - for standard output); see pytest-twin audit --help",
        ),
    ],
)
def test_an_invalid_command_line_is_refused_in_one_line(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    said = err.splitlines()
    if sys.version_info >= (3, 12):
        said = [
            re.sub(r"choose from bash, zsh, fish", "choose from 'bash', 'zsh', 'fish'", said[0])
        ]
    assert said == [line]


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_command_imports_no_other_command(name: str) -> None:
    """Importing all commands would add a second to every short command."""
    run = subprocess.run(
        [sys.executable, "-c", LOADED, name], capture_output=True, text=True, check=True
    )
    loaded = set(run.stdout.splitlines()[-1].split())
    assert loaded == {name}


JSON_COMMANDS = {
    "init": (["{carriage}/axis.xml", "--out", "twin"], "goldens"),
    "intake": (["{golden}", "--out", "arm"], "states"),
    "audit": (["{golden}/arm.urdf"], "counts"),
    "realize": (["{golden}/arm.urdf", "--out", "arm"], "manifest"),
    "replay": (
        ["{golden}/twin.yaml", "{golden}/recordings/moves.mcap", "--out", "predicted.mcap"],
        "joints",
    ),
    "convert": (["{golden}/recordings/moves.mcap", "--out", "converted.mcap"], "written"),
    "show": (["{golden}/recordings/moves.mcap"], "recordings"),
    "effects": ([], "viscous_friction"),
}
"""What each command is called with, and a field of its result."""
TESTED_ELSEWHERE = (
    "diagnose", "calibrate", "excite", "identify", "budget", "randomize", "verify",
    "stamp", "fresh", "shadow", "rollback", "completion", "demo", "check-dataset", "audit-changes",
    "export", "servo", "trend",
)  # fmt: skip
"""Commands with tests of their JSON beside the others of the command."""


def test_every_command_that_writes_json_is_tested() -> None:
    assert {*JSON_COMMANDS, *TESTED_ELSEWHERE} == set(cli.COMMANDS)


@pytest.mark.parametrize("name", JSON_COMMANDS)
def test_json_goes_to_standard_output_and_text_to_standard_error(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    words, field = JSON_COMMANDS[name]
    words = [word.format(golden=GOLDEN, carriage=CARRIAGE) for word in words]
    assert cli.main([name, *words, "--json", "-"]) in (0, 1)
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert field in document
    schema = load_schema(f"results/{name}.schema.json")
    jsonschema.validate(document, schema)
    assert "additionalProperties" in schema or set(document) <= set(schema["properties"])
    assert len(err.splitlines()) > 1


def test_with_json_in_a_file_the_text_stays_on_standard_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["audit", str(GOLDEN / "arm.urdf"), "--json", "found.json"]) in (0, 1)
    out, err = capsys.readouterr()
    assert "report: arm.urdf.audit.html" in out
    assert err == ""
    assert json.loads(Path("found.json").read_text()) == json.loads(
        Path("arm.urdf.audit.json").read_text()
    )


def test_unusable_input_writes_no_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["audit", "missing.urdf", "--json", "-"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shell_completion_contains_every_command_and_option(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in cli.COMMANDS)
    assert "held-out" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)
