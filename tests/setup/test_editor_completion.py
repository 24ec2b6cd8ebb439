"""Editors complete and check twin.yaml, goldens and plans by their modeline, without settings."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest

ROOT = Path(__file__).parents[2]
SCHEMAS = ROOT / "pytest_twin" / "schemas"
PACKAGE = "yaml-language-server@1"


class LanguageServer:
    """A client of the YAML language server: one document at a time."""

    def __init__(self, program: Path) -> None:
        self.process = subprocess.Popen(
            ["node", str(program), "--stdio"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.number = 0
        self.request("initialize", processId=None, rootUri=None, capabilities={})
        self.send("initialized", {})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def send(self, method: str, params: dict[str, Any], number: int | None = None) -> None:
        message: dict[str, Any] = {"jsonrpc": "2.0", "method": method, "params": params}
        if number is not None:
            message["id"] = number
        self.write(message)

    def write(self, message: dict[str, Any]) -> None:
        body = json.dumps(message).encode()
        assert self.process.stdin is not None
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self.process.stdin.flush()

    def receive(self) -> dict[str, Any]:
        stream = self.process.stdout
        assert stream is not None
        length = 0
        while (line := stream.readline().strip()) or not length:
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
        message: dict[str, Any] = json.loads(stream.read(length))
        if "method" in message and "id" in message:
            # Its questions about settings; the defaults are those of an editor.
            items = message.get("params", {}).get("items", [])
            result = [None] * len(items) if message["method"] == "workspace/configuration" else None
            self.write({"jsonrpc": "2.0", "id": message["id"], "result": result})
        return message

    def request(self, method: str, **params: Any) -> Any:
        self.number += 1
        self.send(method, params, self.number)
        while True:
            message = self.receive()
            if message.get("id") == self.number and "method" not in message:
                return message.get("result")

    def problems(self, path: Path, text: str) -> list[str]:
        """What it says of a file with this text."""
        uri = path.as_uri()
        document = {"uri": uri, "languageId": "yaml", "version": 1, "text": text}
        self.send("textDocument/didOpen", {"textDocument": document})
        while True:
            message = self.receive()
            if message.get("method") != "textDocument/publishDiagnostics":
                continue
            if message["params"]["uri"] == uri:
                return [one["message"] for one in message["params"]["diagnostics"]]

    def completions(self, path: Path, line: int, character: int) -> set[str]:
        found = self.request(
            "textDocument/completion",
            textDocument={"uri": path.as_uri()},
            position={"line": line, "character": character},
        )
        return {one["label"] for one in found["items"]}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LanguageServer]:
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("npm or node is not there")
    folder = tmp_path_factory.mktemp("npm")
    command = ["npm", "install", "--silent", "--no-audit", "--prefix", str(folder), PACKAGE]
    try:
        done = subprocess.run(command, capture_output=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{PACKAGE} was not installed in time")
    program = folder / "node_modules" / "yaml-language-server" / "bin" / "yaml-language-server"
    if done.returncode or not program.is_file():
        pytest.skip(f"{PACKAGE} cannot be installed here")
    with LanguageServer(program) as running:
        yield running


def modeline(name: str) -> str:
    return f"# yaml-language-server: $schema={(SCHEMAS / name).as_uri()}\n"


@pytest.mark.parametrize(
    ("schema", "text", "place", "expected"),
    [
        ("twin.schema.json", "schema: 1\n\n", (2, 0), {"model", "topics", "controllers"}),
        ("golden.schema.json", "schema: 1\nkind: \n", (2, 6), {"replay", "fk", "contact"}),
        ("golden.schema.json", "schema: 1\nkind: replay\ntolerance:\n  \n", (4, 2), {"angle_rms"}),
        ("calibration.schema.json", "calibration: a\ncamera:\n  \n", (3, 2), {"mount"}),
        ("audit_baseline.schema.json", "accepted:\n  - \n", (2, 4), {"robot", "why"}),
    ],
)
def test_fields_and_kinds_are_completed(
    server: LanguageServer, tmp_path: Path, schema: str, text: str, place: tuple[int, int],
    expected: set[str],
) -> None:  # fmt: skip
    path = tmp_path / "file.yaml"
    server.problems(path, modeline(schema) + text)
    found = server.completions(path, *place)
    assert expected <= {label.partition(":")[0] for label in found}, found


def test_the_files_of_the_demo_have_no_problem_and_a_wrong_field_has(
    server: LanguageServer,
) -> None:
    files = [ROOT / "golden" / "twin.yaml", *sorted((ROOT / "golden").glob("*/*.yaml"))[::6]]
    assert len(files) > 4
    for path in files:
        text = path.read_text()
        assert text.startswith("# yaml-language-server: $schema=")
        assert server.problems(path, text) == [], path
    wrong = files[1].read_text() + "nothing: 1\n"
    (problem,) = server.problems(files[1].with_name("wrong.yaml"), wrong)
    assert "nothing" in problem
