"""Make the pictures of the README and the docs from real runs.

    python docs/make_pictures.py --work DIR [PICTURE ...]

Needs the recordings (``TWIN_RECORDINGS``, default ``../shared/recordings`` beside the checkout)
and, for pictures of pages, the program ``chromium``. A diagnosis in ``--work`` is used again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from rich.console import Console
from rich.terminal_theme import DIMMED_MONOKAI
from rich.text import Text

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.recordings import read_one
from pytest_twin.report.plot_style import DIM, FAIL, PASS, STYLE, finish

mpl.use("svg")
from matplotlib import pyplot

HERE = Path(__file__).parent
IMAGES = HERE / "images"
RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or HERE.parents[1] / "shared" / "recordings"
).resolve()
PROGRAMS = Path(sys.executable).parent
COLUMNS = 112
GOLDEN = """\
schema: 1
kind: replay
title: The carriage follows the recorded force within 5 mm
target:
  recording: recordings/data_emps_pulses.mcap
tolerance:
  position_rms: 5 mm
"""


def run(folder: Path, program: str, *words: str) -> str:
    """Run a program in a folder as a user does; its text with the codes of a terminal's colours."""
    environment = {k: v for k, v in os.environ.items() if k not in ("CI", "PYTEST_ADDOPTS")}
    command = {"pytest": [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--color=yes"]}
    return subprocess.run(
        [*command.get(program, [str(PROGRAMS / program)]), *words],
        cwd=folder,
        env=environment | {"COLUMNS": str(COLUMNS)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=False,
    ).stdout


def terminal(name: str, command: str, text: str) -> None:
    """A picture of a terminal: the command and what it printed."""
    console = Console(record=True, width=COLUMNS, file=open(os.devnull, "w"), force_terminal=True)  # noqa: SIM115, PTH123
    console.print(Text(f"$ {command}", style="bold"))
    console.print(Text.from_ansi(text.rstrip()))
    console.save_svg(
        str(IMAGES / f"{name}.svg"), title="", theme=DIMMED_MONOKAI, unique_id="pytest-twin"
    )


def page(name: str, path: Path, height: int) -> None:
    """A picture of the top of an HTML page."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        print(f"{name}: left out: no chromium here")
        return
    subprocess.run(
        [
            program, "--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu",
            f"--window-size=1000,{height}", f"--screenshot={IMAGES / name}.png",
            path.resolve().as_uri(),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )  # fmt: skip


def states(path: Path, joint: str) -> tuple[FloatArray, FloatArray]:
    """Time from the first state, s, and position of a joint, rad or m."""
    series = read_one(path).series["state"]
    assert series.position is not None
    time = (series.stamp - series.stamp[0]) * 1e-9
    return time, series.position[:, series.names.index(joint)]


def before_and_after(
    name: str,
    recording: Path,
    predictions: tuple[Path, Path],
    joint: str,
    unit: str,
    words: tuple[str, str],
) -> None:
    """A recording and what the model predicted of it before and after the diagnosis."""
    time, measured = states(recording, joint)
    with mpl.rc_context(STYLE):
        figure, rows = pyplot.subplots(2, 1, figsize=(7.2, 4.2), sharex=True)
        for axes, path, colour, title in zip(rows, predictions, (FAIL, PASS), words, strict=True):
            at, predicted = states(path, joint)
            error = np.sqrt(np.mean((np.interp(time, at, predicted) - measured) ** 2))
            axes.plot(time, measured, color=DIM, linewidth=2.2, label="measured")
            axes.plot(at, predicted, color=colour, label="predicted")
            shown = f"{1000 * error:.0f} m" if error < 1 else f"{error:.1f} "
            axes.set_title(f"{title}: RMS error {shown}{unit}", color=colour)
            axes.set_ylabel(f"{joint} [{unit}]")
            axes.legend(loc="upper left", ncols=2)
            axes.margins(y=0.25)
        rows[-1].set_xlabel("time [s]")
        figure.tight_layout()
        path = IMAGES / f"{name}.svg"
        figure.savefig(path, metadata={"Date": None})
        pyplot.close(figure)
    path.write_text(finish(path.read_text("utf-8")), "utf-8")


def emps(work: Path) -> Path:
    """The twin of the positioning system, diagnosed."""
    folder = work / "emps"
    source = RECORDINGS / "emps"
    (folder / "golden" / "replay").mkdir(parents=True, exist_ok=True)
    (folder / "twin.yaml").write_text(
        f"name: emps\nmodel: {source}/model.xml\nroots:\n  emps: {source}\n"
    )
    golden = folder / "golden" / "replay" / "pulses.yaml"
    if not golden.is_file():
        golden.write_text(GOLDEN)
        run(folder, "pytest", "--twin-update")
    if not (folder / "why" / "diagnosis.json").is_file():
        fit, held_out = (source / "recordings" / f"data_emps{s}.mcap" for s in ("", "_pulses"))
        (folder / "why.txt").write_text(
            run(
                folder, "pytest-twin", "diagnose", "twin.yaml", str(fit),
                "--held-out", str(held_out), "--out", "why", "--seconds", "0",
            )
        )  # fmt: skip
    return folder


def failing_golden(work: Path) -> None:
    """pytest on the positioning system: a failing golden that names viscous friction."""
    terminal("failing_golden", "pytest", run(emps(work), "pytest"))


def diagnosis(work: Path) -> None:
    """The full diagnosis of the positioning system: terminal, page, and the motion."""
    folder = emps(work)
    terminal(
        "diagnosis",
        "pytest-twin diagnose twin.yaml data_emps.mcap --held-out data_emps_pulses.mcap --out why "
        "--seconds 0",
        (folder / "why.txt").read_text(),
    )
    page("diagnosis_report", folder / "why" / "report.html", 1100)
    recording = RECORDINGS / "emps" / "recordings" / "data_emps_pulses.mcap"
    for model in ("twin.yaml", "why"):
        out = f"{Path(model).stem}.mcap"
        run(folder, "pytest-twin", "replay", model, str(recording), "--out", out)
    found = json.loads((folder / "why" / "diagnosis.json").read_text())
    names = " and ".join(f["effect"].replace("_", " ") for f in found["findings"])
    before_and_after(
        "before_after",
        recording,
        (folder / "twin.mcap", folder / "why.mcap"),
        "slide",
        "m",
        ("before: the model has mass alone", f"after: with {names}"),
    )


def so101(work: Path) -> None:
    """One held-out motion of the small arm, before and after.

    The diagnosis is that of ``benchmarks/real/so101.py --out WORK/so101``, which takes an hour.
    """
    folder, source = work / "so101", RECORDINGS / "so101"
    recording = source / "recordings" / "symmetric_motion.mcap"
    model = source / "model.xml"
    for given, out in ((model, "nominal.mcap"), (folder / "why", "patched.mcap")):
        run(folder, "pytest-twin", "replay", str(given), str(recording), "--out", out)
    before_and_after(
        "so101",
        recording,
        (folder / "nominal.mcap", folder / "patched.mcap"),
        "elbow_flex",
        "rad",
        ("before: the vendor's model", "after: the patched model"),
    )


def gate_report(work: Path) -> None:
    """The gate's report of the tutorial's arm after somebody changed a mass."""
    folder = work / "arm_twin"
    folder.mkdir(exist_ok=True)
    tutorial = (HERE / "tutorials" / "first_release.md").read_text("utf-8")
    robot = tutorial.split("```xml\n")[1].split("```")[0]
    if not (folder / "releases").is_dir():
        (folder / "arm.xml").write_text(robot)
        run(folder, "pytest-twin", "init", "arm.xml")
        run(folder, "pytest", "--twin-release")
    (folder / "arm.xml").write_text(robot.replace('mass="0.8"', 'mass="0.9"'))
    run(folder, "pytest")
    page("gate_report", folder / ".twin" / "report.html", 1000)


PICTURES: dict[str, Callable[[Path], None]] = {
    "failing_golden": failing_golden,
    "diagnosis": diagnosis,
    "so101": so101,
    "gate_report": gate_report,
}


def main() -> None:
    """Make the pictures that were asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("pictures", metavar="PICTURE", nargs="*", default=list(PICTURES))
    args = parser.parse_args()
    IMAGES.mkdir(exist_ok=True)
    for name in args.pictures:
        PICTURES[name](args.work.absolute())


if __name__ == "__main__":
    main()
