"""Error messages: complete texts of examples, and a rule for all errors of the package.

Each row of the table causes one error and states its whole text: file, place, value with unit and
expected value. The rule is checked in the source of every error that the package raises.
"""

from __future__ import annotations

import ast
import functools
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import pytest_twin
from pytest_twin import errors
from pytest_twin.checks import check_of
from pytest_twin.formats.trace import read_trace
from pytest_twin.gate.specs import load_golden
from pytest_twin.release import signer
from pytest_twin.release.keys import load_trusted
from pytest_twin.twin import load_twin
from pytest_twin.units import parse_quantity

MODEL = """\
<mujoco>
  <worldbody>
    <body name="link"><joint name="hinge"/><geom type="sphere" size="0.1"/></body>
  </worldbody>
</mujoco>
"""
SPEC = """\
schema: 1
kind: fk
target:
  frames: [link]
stimulus:
  poses: [reference]
tolerance:
  position: 0.1 mm
  orientation: 0.1 mrad
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A twin with one golden spec and no recorded values."""
    root = tmp_path / "arm"
    (root / "golden").mkdir(parents=True)
    (root / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    (root / "arm.xml").write_text(MODEL)
    (root / "golden" / "home.yaml").write_text(SPEC)
    return root


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def twin(change: Callable[[Path], object]) -> Callable[[Path], object]:
    """Reads ``twin.yaml`` after a change."""

    def cause(root: Path) -> object:
        change(root)
        return load_twin(root / "twin.yaml")

    return cause


def golden(old: str, new: str) -> Callable[[Path], object]:
    """Reads the golden spec with one text replaced."""

    def cause(root: Path) -> object:
        edit(root / "golden" / "home.yaml", old, new)
        return load_golden(root / "golden" / "home.yaml", load_twin(root / "twin.yaml"))

    return cause


def trace(text: str) -> Callable[[Path], object]:
    """Reads a stored trace."""

    def cause(root: Path) -> object:
        (root / "golden" / "home.trace.csv").write_text(text)
        return read_trace(root / "golden" / "home.trace.csv")

    return cause


def key(text: str) -> Callable[[Path], object]:
    """Reads the trusted keys of a twin."""

    def cause(root: Path) -> object:
        (root / "keys").mkdir()
        (root / "keys" / "me.pub").write_text(text)
        return load_trusted(root / "keys")

    return cause


def signing_key(place: str, text: str) -> Callable[[Path], object]:
    """Reads a signing key."""

    def cause(root: Path) -> object:
        path = root / place
        path.write_text(text)
        return signer(root, str(path))

    return cause


TABLE: list[tuple[str, Callable[[Path], object], str]] = [
    (
        "no twin.yaml",
        twin(lambda root: (root / "twin.yaml").unlink()),
        "ARM/twin.yaml: no such file (expected a file that exists; check the path)",
    ),
    (
        "twin.yaml without a model",
        twin(lambda root: (root / "twin.yaml").write_text("name: arm\n")),
        "ARM/twin.yaml:1: field 'model' is missing",
    ),
    (
        "twin.yaml with an unknown field",
        twin(lambda root: (root / "twin.yaml").write_text("model: arm.xml\ntpc: link\n")),
        "ARM/twin.yaml:2: tpc: is not a known field (expected one of schema, name, model, "
        "realizations, source, edited, roots, topics, joints, command_mode, columns, units, "
        "time_unit, clock, base, command_between, controller_period, signals, controllers, "
        "payloads, motors, servos, calibration, calibrations, fit, excitation, events, parts, tcp, "
        "accepted_findings, retired, release, authority, fresh, residual, update, shadow, budget, "
        "ranges; did you mean 'topics'?)",
    ),
    (
        "twin.yaml that is no YAML",
        twin(lambda root: (root / "twin.yaml").write_text("model: [arm.xml\n")),
        "ARM/twin.yaml:2:1: not YAML: while parsing a flow sequence did not find expected ','"
        " or ']'",
    ),
    (
        "a key twice",
        twin(lambda root: (root / "twin.yaml").write_text("model: a.xml\nmodel: arm.xml\n")),
        "ARM/twin.yaml:2:1: key 'model' occurs a second time (first: 1)",
    ),
    (
        "a model that is missing",
        twin(lambda root: (root / "arm.xml").unlink()),
        "ARM/twin.yaml:2: no such file (got 'arm.xml'; expected a file that exists; relative paths "
        "start at ARM)",
    ),
    (
        "a model outside the twin",
        twin(lambda root: (root / "twin.yaml").write_text("model: ../arm.xml\n")),
        "ARM/twin.yaml:1: path leaves the declared roots (got '../arm.xml'; expected a path "
        "inside ARM; to allow that folder: --root ABOVE on the command line, or 'roots: "
        "[ABOVE]' in twin.yaml)",
    ),
    (
        "a model that is a folder",
        twin(lambda root: (root / "twin.yaml").write_text("model: golden\n")),
        "ARM/twin.yaml:1: model: not a kind of model that can be loaded (got 'golden'; "
        "expected MJCF (.xml, .mjcf), URDF (.urdf), or the folder of a diagnosis)",
    ),
    (
        "a rule with a number as text",
        twin(
            lambda root: (root / "twin.yaml").write_text(
                "model: arm.xml\nrelease: {valid_days: long}\n"
            )
        ),
        "ARM/twin.yaml:2: release.valid_days: is text (got 'long'; expected a number)",
    ),
    (
        "an unknown kind",
        golden("kind: fk", "kind: fkk"),
        "ARM/golden/home.yaml:2: kind: unknown kind (got 'fkk'; expected asset, calibration, "
        "collision_distance, contact, fk, frequency_response, identification, joint_direction, "
        "limits, mass_properties, replay, sensor_timing, settling, step, task, tcp_accuracy)",
    ),
    (
        "a tolerance without unit",
        golden("0.1 mm", "0.1"),
        "ARM/golden/home.yaml:8: tolerance.position: is a number (got 0.1; expected a number "
        "with its unit, such as '0.5 mm')",
    ),
    (
        "a tolerance in another unit",
        golden("0.1 mm", "0.1 s"),
        "ARM/golden/home.yaml:8: tolerance.position: unit 's' does not fit (got '0.1 s'; "
        "expected a number and a unit, such as '1 m' or '1 mm' or '1 um')",
    ),
    (
        "a negative tolerance",
        golden("0.1 mm", "-0.1 mm"),
        "ARM/golden/home.yaml:8: tolerance.position: the tolerance is negative"
        " (got '-0.1 mm'; expected zero or more)",
    ),
    (
        "an unknown tolerance",
        golden("position: 0.1 mm", "positoin: 0.1 mm"),
        "ARM/golden/home.yaml:8: tolerance.positoin: is not a known field (expected one of "
        "orientation, position; did you mean 'position'?)",
    ),
    (
        "an unknown realization",
        golden("kind: fk", "kind: fk\nrealizations: [usd]"),
        "ARM/golden/home.yaml:3: realizations: twin 'arm' has no such realization (got 'usd';"
        " expected one of mujoco)",
    ),
    (
        "an unknown field of a spec",
        golden("kind: fk", "kind: fk\nnote: x"),
        "ARM/golden/home.yaml:3: note: is not a known field (expected one of schema, kind, "
        "title, realizations, criticality, target, stimulus, tolerance, expected, trace, "
        "provenance)",
    ),
    (
        "a spec without frames",
        golden("  frames: [link]", "  frames: []"),
        "ARM/golden/home.yaml:4: target.frames: holds 0 (expected at least 1)",
    ),
    (
        "a trace that is empty",
        trace(""),
        "ARM/golden/home.trace.csv:1: empty file (expected a header and rows of numbers)",
    ),
    (
        "a trace with text for a number",
        trace("time [s],a [m]\n0,0\n1,x\n"),
        "ARM/golden/home.trace.csv:3: a: not a finite number (got 'x' m; expected a finite number)",
    ),
    (
        "a trace with too few numbers",
        trace("time [s],a [m]\n0,0\n1\n"),
        "ARM/golden/home.trace.csv:3: row has 1 value (expected 2, one per heading)",
    ),
    (
        "a heading without unit",
        trace("time [s],a\n0,0\n"),
        "ARM/golden/home.trace.csv:1: heading 2 is not a name with a unit (got 'a'; expected "
        "such as 'time [s]')",
    ),
    (
        "a trusted key that is none",
        key("ssh-ed25519 AAAA"),
        "ARM/keys/me.pub: not a public key that releases are signed with (expected an Ed25519"
        " public key in PEM)",
    ),
    (
        "a signing key that is none",
        signing_key("../key.pem", "x"),
        "ARM/../key.pem: not a key to sign with (expected an Ed25519 private key in PEM (PKCS"
        " #8) without a passphrase)",
    ),
    (
        "a signing key inside the twin",
        signing_key("key.pem", "x"),
        "ARM/key.pem: the signing key is inside the twin, where it would be published "
        "(expected a path outside ARM)",
    ),
    (
        "a quantity without number",
        lambda root: parse_quantity("mm", ("m",)),
        "not a quantity with a unit (got 'mm'; expected a number and a unit, such as '1 m' or '1"
        " mm' or '1 um')",
    ),
    (
        "a kind that nobody installed",
        lambda root: check_of("weld"),
        "kind: unknown kind (got 'weld'; expected asset, calibration, collision_distance, contact, "
        "fk, frequency_response, identification, joint_direction, limits, mass_properties, "
        "replay, sensor_timing, settling, step, task, tcp_accuracy)",
    ),
]


@pytest.mark.parametrize(("name", "cause", "text"), TABLE, ids=[row[0] for row in TABLE])
def test_the_error_has_exactly_this_text(
    arm: Path, name: str, cause: Callable[[Path], object], text: str
) -> None:
    with pytest.raises(errors.TwinError) as raised:
        cause(arm)
    assert str(raised.value).replace(str(arm), "ARM").replace(str(arm.parent), "ABOVE") == text


# -- the rule

ROOT = Path(pytest_twin.__file__).parent
TYPED = {
    name
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.TwinError)
}
# Function that makes an error of a golden with file and line: (golden, field, problem).
PLACED = "spec_error"
# Phrases of the style guide's "not" column that could occur in messages.
NOT_PLAIN = (
    *("stands above", "as it came", "that stands", "in its place", "takes off", "told by"),
    *("what is left", "hold each other", "to be surer", "astray", "a seventieth"),
)
# Variables with the text of a re-raised cause, in which the system or a library states details.
OWN_WORDS = {"error", "words", "reason"}
# Numbers of errors without a place, which the caller adds. They may only decrease.
WITHOUT_PLACE = {
    "release": 18,  # errors in an envelope's bytes: `check` adds the folder
    "realization": 12,  # errors of a child process: the gate adds the golden
    "units.py": 3,  # errors in a text: the reader of the spec adds file, line and field
    "formats": 2,
    "gate": 1,  # a text that already contains its place
    "commands": 1,
    "setup": 2,  # errors in a tolerance's text: the command line adds the option
}
# Errors without an expected value, each with the reason.
WITHOUT_EXPECTATION = {
    "gate/update.py UnwrittenToleranceError": "its text is a whole error of the spec's reader",
}


@functools.cache
def calls_and_raises() -> list[tuple[Path, ast.Call | ast.Raise]]:
    """All calls and ``raise`` statements of the package, each with its file."""
    return [
        (path, node)
        for path in sorted(ROOT.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call | ast.Raise)
    ]


@functools.cache
def error_sites() -> list[tuple[str, ast.Call]]:
    """Calls in the package that make a typed error: ``folder/file.py:line`` and the call."""
    return [
        (f"{path.relative_to(ROOT).as_posix()}:{node.lineno}", node)
        for path, node in calls_and_raises()
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in (*TYPED, PLACED)
    ]


def top_folder(site: str) -> str:
    return site.split("/")[0].split(":")[0]


def has_keyword(call: ast.Call, *names: str) -> bool:
    """Whether a call has one of these keywords, or ``**`` keywords."""
    return any(keyword.arg is None or keyword.arg in names for keyword in call.keywords)


def problem_of(call: ast.Call) -> ast.expr | None:
    """The argument of a call that states the problem."""
    placed = isinstance(call.func, ast.Name) and call.func.id == PLACED
    problem = call.args[2:] if placed else call.args
    return problem[0] if problem else None


def texts(call: ast.Call) -> Iterator[str]:
    """Every literal text in a call."""
    for node in ast.walk(call):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_the_rule_covers_the_errors_of_all_folders() -> None:
    assert len(error_sites()) > 300
    assert {"formats", "release", "realization", "checks"} <= {
        top_folder(site) for site, _ in error_sites()
    }


def test_no_error_message_ends_with_a_full_stop() -> None:
    ends = [
        site
        for site, call in error_sites()
        for text in (
            problem_of(call),
            *(k.value for k in call.keywords if k.arg == "expected"),
        )
        if isinstance(text, ast.Constant) and str(text.value).endswith(".")
    ]
    assert ends == []


def test_no_error_message_contains_a_vague_phrase() -> None:
    found = [
        (site, phrase)
        for site, call in error_sites()
        for text in texts(call)
        for phrase in NOT_PLAIN
        if phrase in text
    ]
    assert found == []


def test_errors_state_where_the_problem_is() -> None:
    without = [
        site
        for site, call in error_sites()
        if ast.unparse(call.func) != PLACED and not has_keyword(call, "path", "where")
    ]
    assert_no_more(without, WITHOUT_PLACE)


def includes_its_cause(call: ast.Call) -> bool:
    """Whether the text of an error includes the text of its cause."""
    problem = problem_of(call)
    if not isinstance(problem, ast.JoinedStr):
        return False
    filled = [part for part in problem.values if isinstance(part, ast.FormattedValue)]
    names = {n.id for part in filled for n in ast.walk(part) if isinstance(n, ast.Name)}
    return not OWN_WORDS.isdisjoint(names)


def test_errors_state_the_expected_value() -> None:
    without = {
        f"{site.split(':')[0]} {ast.unparse(call.func)}"
        for site, call in error_sites()
        if not has_keyword(call, "expected") and not includes_its_cause(call)
    }
    assert without == set(WITHOUT_EXPECTATION)


def test_errors_of_model_elements_state_the_expected_value() -> None:
    """Model elements and twins make their own errors: ``raise node.error(...)``."""
    without, seen = [], 0
    for path, node in calls_and_raises():
        call = node.exc if isinstance(node, ast.Raise) else None
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)):
            continue
        if call.func.attr != "error":
            continue
        seen += 1
        if not has_keyword(call, "expected") and not includes_its_cause(call):
            without.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert seen > 50
    assert without == []


def assert_no_more(sites: list[str], allowed: dict[str, int]) -> None:
    counts = Counter(map(top_folder, sites))
    more = {name: count for name, count in counts.items() if count > allowed.get(name, 0)}
    assert more == {}, [site for site in sites if top_folder(site) in more]
