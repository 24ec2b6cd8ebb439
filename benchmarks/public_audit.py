"""Audit public collections of robots, and write which findings they have.

    python benchmarks/public_audit.py FOLDER... --state audits.jsonl --page docs/public_audit.md

Each FOLDER is one collection: a clone of MuJoCo Menagerie, or an unpacked package such as
`pip install --no-deps --target FOLDER example-robot-data`. Every URDF and MJCF in it with joints,
scenes apart, is audited in a child process. The state file has a line for each robot, so an
interrupted run can be continued.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import shipped

from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.realization.sandbox import Sandbox

_KEPT = ("code", "severity", "element", "title", "value", "unit", "expected", "line")
_MOST_OF_A_ROBOT = 3
"""Critical findings that the page prints of a robot; more are counted."""


def robots(folder: Path) -> list[Path]:
    """Files with joints. A scene adds a floor to a robot: the robot's own file is audited."""
    return [p for p in shipped.models(folder) if shipped.has_joints(p) and "scene" not in p.name]


def run(folders: list[Path], state: Path, seconds: float) -> None:
    """Add a line to the state file for each robot that is not in it."""
    known = {line["path"] for line in shipped.read_state(state)}
    for folder in folders:
        with Sandbox(seconds=seconds) as child:
            for path in robots(folder):
                name = f"{folder.name}/{'/'.join(path.relative_to(folder).parts[-3:])}"
                if name in known:
                    continue
                line: dict[str, Any] = {"path": name, "collection": folder.name}
                try:
                    report = child.call(
                        "pytest_twin.audit.audit_file:audit_file", {"path": str(path)}
                    )
                    line["findings"] = [
                        {key: one[key] for key in _KEPT} for one in report["findings"]
                    ]
                except TwinError as error:
                    line["refused"] = re.sub(r"/\S*/", "", str(error))[:200]
                shipped.add_line(state, line)
                print(name, file=sys.stderr, flush=True)


def page(lines: list[dict[str, Any]]) -> str:
    """Return the page: the findings of each code, and what is critical in each robot."""
    audited = [line for line in lines if "findings" in line]
    collections = Counter(line["collection"] for line in audited)
    rows = [
        "# What an audit finds in public robots",
        "",
        "<!-- not run on this page: it needs the collections, and takes minutes -->",
        "",
        "Written by `python benchmarks/public_audit.py`: robots of "
        + ", ".join(f"{name} ({count})" for name, count in sorted(collections.items()))
        + ". A finding is a statement about the file: nobody here measured the robots. Files that "
        "are meant for use in another one, such as a gripper without its arm, are audited like "
        "any other.",
        "",
        "To audit other robots, such as a clone of MuJoCo Menagerie, or your own:",
        "",
        "```sh",
        "pip install --no-deps --target robots/example-robot-data example-robot-data",
        "python benchmarks/public_audit.py robots/* --state audits.jsonl --page audits.md",
        "```",
        "",
        "## Findings by code",
        "",
        "Of the severities `critical` and `warning`; *robots* have it at least once.",
        "",
        "| code | severity | robots | findings | example |",
        "| --- | --- | --- | --- | --- |",
    ]
    with_code: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = defaultdict(list)
    for line in audited:
        for finding in line["findings"]:
            if finding["severity"] in ("critical", "warning"):
                key = (finding["severity"], finding["code"])
                with_code[key].append((line["path"], finding))
    for (severity, code), each in sorted(
        with_code.items(), key=lambda item: (item[0][0], -len({path for path, _ in item[1]}))
    ):
        path, finding = each[0]
        count = len({path for path, _ in each})
        example = f"`{Path(path).name}`, {_text(finding)}"
        rows.append(f"| `{code}` | {severity} | {count} | {len(each)} | {example} |")
    rows += ["", "## Critical findings by robot", ""]
    for line in audited:
        critical = [one for one in line["findings"] if one["severity"] == "critical"]
        if critical:
            printed = "; ".join(_text(one) for one in critical[:_MOST_OF_A_ROBOT])
            more = len(critical) - _MOST_OF_A_ROBOT
            rest = f"; and {more} more" if more > 0 else ""
            rows.append(f"- `{line['path']}`: {printed}{rest}")
    refused = [line for line in lines if "refused" in line]
    if refused:
        rows += ["", "## Not audited", ""]
        rows += [f"- `{line['path']}`: {line['refused']}" for line in refused]
    return "\n".join([*rows, ""])


def _text(finding: dict[str, Any]) -> str:
    unit = f" {finding['unit']}" if finding["unit"] else ""
    value = finding["value"]
    short = f"{value:.3g}" if isinstance(value, float) else str(value)[:60]
    stated = f" ({short}{unit})" if value is not None else ""
    return f"{finding['element']}: {finding['title']}{stated}".replace("|", "/").replace("\n", " ")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="*", help="collections of robots")
    parser.add_argument("--state", type=Path, required=True, help="a line for each robot")
    parser.add_argument("--seconds", type=float, default=120.0, help="bound on each audit")
    parser.add_argument("--page", type=Path, help="write the page here")
    args = parser.parse_args()
    run([folder.resolve() for folder in args.folders], args.state, args.seconds)
    text = page(shipped.read_state(args.state))
    if args.page is None:
        print(text)
    else:
        atomic.write_text(args.page, text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
