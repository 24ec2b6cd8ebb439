"""``pytest-twin budget``: write the error budget of the task's frame."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.release_folder import TWIN_HELP, twin_file
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.formats import atomic
from pytest_twin.report import budget

EXAMPLES = (
    "pytest-twin budget twin.yaml --out budget/",
    "pytest-twin budget cell/ --out cell/budget/ --json - | jq .total",
)
EXIT_STATUS = {0: "the budget is written, with a list of unmeasured error sources"}
JSON_NAME, PAGE_NAME = "budget.json", "budget.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("twin", metavar="TWIN", type=Path, help=TWIN_HELP)
    add_out(parser, f"folder for {JSON_NAME} and {PAGE_NAME}")
    add_seconds(parser, 0.0, "the lines so far are written, and the others are unknown")
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the budget; return 0.

    Raises:
        TwinError: a twin, record or recording cannot be used.
    """
    twin = twin_file(args.twin)
    out: Path = args.out
    progress = Progress("propagating")
    with progress.stopping_early("the lines so far are written") as stop:
        with (
            child_result(out, JSON_NAME, args.seconds, stop) as (staging, sandbox),
            progress,
        ):
            document = sandbox.call(
                "pytest_twin.budget.budget_of_twin:budget_of_file",
                {
                    "path": str(twin.absolute()),
                    "folder": str(out.absolute()),
                    "seconds": args.seconds,
                },
                progress=progress,
            )
            atomic.write_json(staging / JSON_NAME, document)
            atomic.write_text(staging / PAGE_NAME, budget.render(document))
        json_output.give(args, document)
        show_lines(_words(document))
        show(f"report: {out / PAGE_NAME}, {out / JSON_NAME}")
        return 0


def _words(document: dict[str, Any]) -> list[str]:
    """Return the summary for people: the verdict, the estimates' share, then each category."""
    output, total = document["output"], document["total"]
    lines = [f"error budget of {document['twin']!r}: pose of {output['frame']!r}"]
    lines += [f"  {line}" for line in document["words"]]
    lines.append(f"  {output['frame_source']}; {output['poses_source']}")
    if total["sampled"] is None:
        none = "no record of this twin affects the frame"
        why = "no record was tried" if document["not_tried"] else none
        lines.append(f"  by the estimates: {why}")
    else:
        lines.append(f"  by the estimates: {_size(total['sampled'])}{_share(total['share'])}")
    for one in document["categories"]:
        lines.append(f"  {one['category'].replace('_', ' ')}: {_state(one)}")
    for line in document["lines"]:
        lines += [f"  warning: {line['id']}: {text}" for text in line["warnings"]]
    return [*lines, *(f"  note: {note}" for note in document["notes"])]


def _state(one: dict[str, Any]) -> str:
    if one["state"] == "not_tried":
        return "not known: not every record was tried"
    if one["state"] == "not_measured":
        return f"not measured; {one['measured_by']}"
    if one["state"] == "counted_elsewhere":
        return f"counted with {', '.join(one['counted_in'])}, which estimated it together"
    if one["beyond"] is not None:
        sizes = [
            f"{1e3 * value:.3g} {unit}"
            for value, unit in zip(one["beyond"].values(), ("mm", "mrad"), strict=True)
            if value is not None
        ]
        return f"up to {', '.join(sizes)} of held-out error is not explained"
    if one["moves"] is None:
        return f"measured by {', '.join(one['lines'])}; not carried to the frame"
    return f"{_size(one['moves'])}{_share(one['share'])}, from {', '.join(one['lines'])}"


def _size(spread: dict[str, float]) -> str:
    return f"{1e3 * spread['position']:.3g} mm, {1e3 * spread['rotation']:.3g} mrad"


def _share(share: dict[str, float | None]) -> str:
    stated = [f"{100 * value:.3g} % of the {name}" for name, value in share.items()
              if value is not None]  # fmt: skip
    return f" ({', '.join(stated)} that the task allows)" if stated else ""
