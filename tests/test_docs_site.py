"""The documentation builds without warnings and its references exist."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("sphinx", reason="the extra 'docs' is not installed")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-E"]
    run = subprocess.run(
        [*command, "-d", str(out / "doctrees"), str(DOCS), str(out / "html")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return out / "html"


def test_every_page_of_the_docs_is_in_the_site(site: Path) -> None:
    pages = {path.relative_to(DOCS).with_suffix(".html") for path in DOCS.rglob("*.md")}
    assert pages <= {path.relative_to(site) for path in site.rglob("*.html")}


def test_the_reference_covers_every_command_kind_file_and_error(site: Path) -> None:
    from pytest_twin import cli, errors
    from pytest_twin.checks import kinds

    folder = site / "reference" / "generated"
    commands = (folder / "commands.html").read_text()
    assert all(f'<section id="{name}">' in commands for name in cli.COMMANDS)
    fields = (folder / "golden_kinds.html").read_text()
    assert all(f'id="{kind.replace("_", "-")}"' in fields for kind in kinds())
    files = re.sub(r"<[^>]+>", "", (folder / "files.html").read_text())
    assert "findings[].confidence" in files
    results = list((ROOT / "pytest_twin" / "schemas" / "results").iterdir())
    # Each title occurs as a heading and in the table of contents.
    assert files.count("--json -") == 2 * len(results), [p.name for p in results]
    named = (folder / "errors.html").read_text()
    assert all(
        name in named
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, Exception)
    )


def test_the_reference_covers_the_public_interface(site: Path) -> None:
    page = (site / "reference" / "generated" / "api.html").read_text()
    for module in ("pytest_twin.checks", "pytest_twin.effects", "pytest_twin.properties"):
        exported = importlib.import_module(module)
        for name in exported.__all__:
            if inspect.isclass(one := getattr(exported, name)) or inspect.isfunction(one):
                assert re.search(rf'id="[\w.]*\.{name}"', page), f"{module}.{name}"
    for protocol in ("ModelFormat.mjcf", "Layer.check", "Reader.reads", "Reader.read"):
        assert f'.{protocol}"' in page


def test_every_module_named_on_the_page_how_it_works_exists() -> None:
    page = (DOCS / "explanation" / "how-it-works.md").read_text()
    named = {
        name for name in re.findall(r"`([a-z_.]+)`", page) if not name.endswith((".yaml", ".json"))
    }
    named |= set(pictures().modules())
    assert len(named) > 40
    missing = [
        name
        for name in sorted(named)
        if not ((place := ROOT / "pytest_twin" / name.replace(".", "/")).is_dir())
        and not place.with_suffix(".py").is_file()
    ]
    assert missing == []


def test_every_module_named_on_the_diagnosis_page_exists() -> None:
    page = (DOCS / "explanation" / "how-a-diagnosis-works.md").read_text()
    groups = re.findall(r"\((`[a-z_/`,\s]+)\)", page)
    named = {name for group in groups for name in re.findall(r"`([a-z_/]+)`", group)}
    assert len(named) > 20
    folder = ROOT / "pytest_twin" / "diagnosis"
    exist = {
        name for name in named if (folder / name).is_dir() or (folder / f"{name}.py").is_file()
    }
    assert named - exist == set()


def test_every_file_named_on_a_page_exists() -> None:
    place = re.compile(
        r"(?<![\w./-])((?:pytest_twin|tests|benchmarks|docs|examples)/[\w/.-]+\.\w+)"
    )
    pages = [*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "benchmarks").rglob("*.md")]
    missing = {
        f"{page.name}: {named}"
        for page in pages
        if "generated" not in page.parts
        for named in place.findall(page.read_text())
        if not (ROOT / named).is_file()
    }
    assert missing == set()


def test_the_pictures_are_up_to_date() -> None:
    for name, text in pictures().PICTURES.items():
        assert (DOCS / "images" / name).read_text("utf-8") == text


def test_every_command_in_the_picture_of_questions_exists() -> None:
    from pytest_twin import cli

    commands = {command.split()[0] for _, row in pictures().QUESTIONS for _, command in row}
    assert commands - {"pytest"} <= set(cli.COMMANDS)


def pictures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw_pictures", DOCS / "draw_pictures.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_links_in_the_readme_have_a_target() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text()
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"", text):
            path = target[0] or target[1]
            if not path.startswith("http"):
                assert (ROOT / path).exists(), f"{name}: {path}"
