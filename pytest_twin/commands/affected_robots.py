"""Find the robot files of a git checkout that a change affects."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Collection, Iterable
from pathlib import Path

from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import xml
from pytest_twin.formats.expansions import SUFFIX as XACRO

_ROBOTS = (".urdf", ".srdf", XACRO, ".xml", ".mjcf")
"""Ends of the names of robot files and of the files that they include."""
_XACRO_NAMESPACES = ("{http://www.ros.org/wiki/xacro}", "{http://wiki.ros.org/xacro}",
                     "{http://ros.org/wiki/xacro}", "{http://www.ros.org/xacro}")  # fmt: skip
_DECLARATIONS = {"macro", "property", "arg", "include"}
"""Elements of xacro that add nothing to a robot."""
_READ_BYTES = 2**24
"""Larger files are not searched for the names of other files."""
_SECONDS = 60


def checkout() -> Path:
    """Return the root of the git checkout of the working directory.

    Raises:
        SpecError: there is none.
    """
    return Path(_git(Path(), "rev-parse", "--show-toplevel")[0])


def changed_since(root: Path, revision: str) -> list[Path]:
    """Return files that differ from the merge base with a revision, committed or not.

    Raises:
        SpecError: git does not know the revision, or no common ancestor.
    """
    if revision.startswith("-"):
        raise SpecError(
            "not a revision", where="--since", value=revision, expected="a git revision"
        )
    base = _git(root, "merge-base", revision, "HEAD")[0]
    return [root / name for name in _git(root, "diff", "--name-only", "-z", base, "--")]


def affected(root: Path, changed: Collection[Path] | None) -> list[Path]:
    """Return the robot files that a change affects, sorted.

    A robot is affected if its file changed, or a file whose name it or a file that it includes
    contains, such as a mesh.

    Args:
        root: root of the checkout.
        changed: changed files; None for all robots.
    """
    tracked = [root / name for name in _git(root, "ls-files", "-z")]
    texts = {path: _text(path) for path in tracked if path.suffix.lower() in _ROBOTS}
    robots = [path for path in texts if _is_robot(path, texts)]
    if changed is None:
        return sorted(robots)
    reached = {path.resolve() for path in changed}
    names = {path.name for path in reached}
    while True:
        more = {
            path for path, text in texts.items()
            if path.resolve() not in reached and any(name in text for name in names)
        }  # fmt: skip
        if not more:
            break
        reached |= {path.resolve() for path in more}
        names = {path.name for path in more}
    return sorted(path for path in robots if path.resolve() in reached)


def _git(folder: Path, *words: str) -> list[str]:
    """Run git; return its output, split at NUL or line ends."""
    command = ["git", "-C", str(folder), *words]
    try:
        run = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SpecError("git cannot be run", where=words[0], value=str(error)[:80],
                        expected="git, in a checkout") from None  # fmt: skip
    if run.returncode != 0:
        said = run.stderr.decode(errors="replace").strip().splitlines() or [""]
        raise SpecError(
            f"git {words[0]} failed", path=folder.resolve(), value=said[0][:200],
            expected="a checkout with the history back to the revision (fetch-depth: 0)",
        )  # fmt: skip
    output = run.stdout.decode(errors="surrogateescape")
    return [part for part in re.split("[\0\n]" if "-z" not in words else "\0", output) if part]


def _text(path: Path) -> str:
    try:
        if path.is_file() and path.stat().st_size <= _READ_BYTES:
            return path.read_text("utf-8", errors="replace")
    except OSError:
        pass
    return ""


def _is_robot(path: Path, texts: dict[Path, str]) -> bool:
    """Whether a file describes a robot of its own, and is not only a part to include."""
    suffix = path.suffix.lower()
    if suffix == ".srdf":
        return True
    if not texts[path]:
        return False
    try:
        document = xml.parse(path)
    except TwinError:
        # A URDF that cannot be read is reported by its audit.
        return suffix == ".urdf"
    if suffix in (".xml", ".mjcf"):
        return document.tag == "mujoco" and document.find("worldbody//body") is not None
    if suffix == XACRO:
        others = (text for other, text in texts.items() if other.suffix == XACRO and other != path)
        return _adds_links(document) and not any(path.name in text for text in others)
    return document.tag == "robot"


def _adds_links(elements: Iterable[xml.Element]) -> bool:
    """Whether a xacro file has a link or calls a macro, outside its own macros."""
    for element in elements:
        tag = str(element.tag)
        name = next((tag.removeprefix(n) for n in _XACRO_NAMESPACES if tag.startswith(n)), None)
        if tag == "link" or (name is not None and name not in {*_DECLARATIONS, "if", "unless"}):
            return True
        if name in ("if", "unless") and _adds_links(element):
            return True
    return False
