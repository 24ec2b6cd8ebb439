"""Draw the pictures of README and of ``explanation/how-it-works.md``.

    python docs/draw_pictures.py

Boxes name commands and modules: a renamed one fails the tests of the pictures.
"""

from __future__ import annotations

import textwrap
from html import escape
from pathlib import Path

IMAGES = Path(__file__).parent / "images"

QUESTIONS = (
    ("A robot's file", (
        ("What is wrong with it?", "audit"),
        ("What do other formats lose?", "realize"),
        ("How do I make it a twin?", "init"),
    )),
    ("A twin", (
        ("Did a change make it worse?", "pytest"),
        ("May others rely on it?", "pytest --twin-release"),
        ("Is this what was signed?", "verify"),
        ("Which data are out of date?", "fresh"),
    )),
    ("Recordings", (
        ("What is in this log?", "show"),
        ("How far off is the model?", "replay"),
        ("Which physics is missing?", "diagnose"),
        ("What changed since May?", "diagnose --before"),
    )),
    ("A finding", (
        ("Which motion confirms it?", "excite --separate"),
        ("Since when is it so?", "trend"),
        ("How does Newton get it?", "export"),
    )),
    ("Time at the robot", (
        ("Which motions do I record?", "excite"),
        ("Where are zeros, tool, camera?", "calibrate"),
        ("Which inertia and friction?", "identify"),
    )),
    ("Training", (
        ("Is this data set sound?", "check-dataset"),
        ("How much do I randomize?", "randomize"),
        ("How far off is the tool?", "budget"),
        ("Which release made these data?", "stamp"),
    )),
)  # fmt: skip
"""What one has, the questions that this answers, and the command of each."""

INPUTS = (
    ("twin", "twin.yaml: model files, calibrations, fits, limits"),
    ("realization", "the model, loaded and checked in a child process"),
    ("formats.recordings", "recordings of any format, in SI units"),
    ("trial", "one clock, the model's joint names, parts without gaps"),
)
WAYS: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "gate": (
        "pytest --twin-release",
        (
            ("parts", "parts of the model, each with a digest"),
            ("plan", "stale goldens, each with the reason"),
            ("worker", "stimulus and comparison, in a child process"),
            ("verdict", "release or refusal, from outcomes alone"),
            ("run_end", "signed release and report"),
        ),
    ),
    "diagnosis": (
        "diagnose",
        (
            ("trials", "recordings to fit and to hold out"),
            ("prepare", "residual and noise floor of each joint"),
            ("first_order", "effects ranked by linearized dynamics"),
            ("search", "sets of effects, fitted by simulation"),
            ("conclusion", "test errors, findings, patched model"),
        ),
    ),
    "calibration": (
        "calibrate",
        (
            ("problem", "unknown zeros, links and frames"),
            ("starts", "start values from algebraic solvers"),
            ("solve", "robust least squares, outliers listed"),
            ("observability", "directions that the poses determine"),
            ("records", "estimates with covariance"),
        ),
    ),
    "identification": (
        "identify",
        (
            ("roles", "recordings to fit and to hold out"),
            ("regressor", "inverse dynamics, base parameters"),
            ("stages", "fit in order, each tested on held-out data"),
            ("full_parameters", "inertias that real bodies can have"),
            ("write", "fitted model and its record"),
        ),
    ),
    "excitation": (
        "excite",
        (
            ("approved_limits", "limits that a person approved"),
            ("designs", "steps, chirps, static grid, Fourier series"),
            ("find_safe", "scaled down or redrawn until safe"),
            ("prediction", "covariance to expect from the motion"),
            ("files", "CSV, MCAP, ROS 2 trajectory"),
        ),
    ),
    "budget": (
        "budget",
        (
            ("task", "frame and poses of the task"),
            ("calibration", "covariance of the calibrations"),
            ("identification", "covariance of the identifications"),
            ("propagate", "error of the frame's pose"),
            ("lines", "one line for each record"),
        ),
    ),
    "ranges": (
        "randomize",
        (
            ("gather", "joint distribution from the twin's records"),
            ("widening", "wider where held-out error is larger"),
            ("simulate", "many robots under recorded commands"),
            ("check", "final recordings inside the envelope"),
            ("ranges_of_twin", "ranges.json"),
        ),
    ),
}
RETURN = ("diagnosis", "calibration", "identification")
"""Ways whose result enters ``twin.yaml``."""

LEFT, WIDTH, HEIGHT, GAP, TITLE = 8, 142, 84, 12, 134
TOP = 118
STEP = HEIGHT + 16


def modules() -> list[str]:
    """Every module that a box names, without ``pytest_twin.``."""
    ways = [f"{room}.{name}" for room, (_, boxes) in WAYS.items() for name, _ in boxes]
    return [*(name for name, _ in INPUTS), *ways]


def questions() -> str:
    """The SVG of README: what one has, and which command answers which question."""
    width, height, step = 196.0, 66.0, 76.0
    across = LEFT + TITLE + 4 * (width + GAP) + LEFT
    parts = [_head(across, 8 + len(QUESTIONS) * step, "Which command answers which question")]
    for row, (owned, answers) in enumerate(QUESTIONS):
        y = 4 + row * step
        parts.append(_box(LEFT, y, TITLE, height, "way", owned, ""))
        for column, (question, command) in enumerate(answers):
            x = LEFT + TITLE + GAP + column * (width + GAP)
            parts.append(_box(x, y, width, height, "step", question, command))
    return "\n".join([*parts, "</svg>", ""])


def ways() -> str:
    """The SVG of the page. Text is on filled boxes: legible on light and dark pages."""
    across = TITLE + GAP + 5 * (WIDTH + GAP)
    down = TOP + len(WAYS) * STEP + 4
    title = "The ways through pytest-twin: inputs, then one row for each command"
    parts = [_head(across + LEFT + 26, down, title)]
    wide = (across - 3 * GAP) / len(INPUTS)
    for number, (name, text) in enumerate(INPUTS):
        parts.append(_box(LEFT + number * (wide + GAP), 8, wide, 76, "input", text, name))
    for row, (room, (command, boxes)) in enumerate(WAYS.items()):
        y = TOP + row * STEP
        parts.append(_box(LEFT, y, TITLE, HEIGHT, "way", command, f"{room}/"))
        for column, (name, text) in enumerate(boxes):
            x = LEFT + TITLE + GAP + column * (WIDTH + GAP)
            parts.append(_arrow(x - GAP, y + HEIGHT / 2, x))
            kind = "result" if column == len(boxes) - 1 else "step"
            parts.append(_box(x, y, WIDTH, HEIGHT, kind, text, name))
    parts.append(_return(across + LEFT))
    return "\n".join([*parts, "</svg>", ""])


def _head(width: float, height: float, title: str) -> str:
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}"
  font-family="system-ui, 'Segoe UI', 'Noto Sans', 'DejaVu Sans', sans-serif" font-size="12.5">
<title>{title}</title>
<style>
rect {{ stroke: #7d8b99; rx: 6px }}
.input {{ fill: #fff3d6 }} .way {{ fill: #2f5f8f }} .step {{ fill: #eef3f8 }}
.result {{ fill: #d9efdf }}
text {{ fill: #17212b }} .onway {{ fill: #ffffff; font-weight: 600 }}
.module {{ font-family: ui-monospace, 'DejaVu Sans Mono', monospace; font-size: 12px }}
path {{ stroke: #7d8b99; stroke-width: 2; fill: none }} .tip {{ fill: #7d8b99; stroke: none }}
</style>"""


def _box(x: float, y: float, width: float, height: float, kind: str, text: str, name: str) -> str:
    lines = textwrap.wrap(text, int(width / 7.6), break_on_hyphens=False)
    color = ' class="onway"' if kind == "way" else ""
    module = f"module{' onway' if kind == 'way' else ''}"
    written = [
        f'<text x="{x + 8:g}" y="{y + 19 + 15 * at:g}"{color}>{escape(line)}</text>'
        for at, line in enumerate(lines)
    ]
    rect = f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" class="{kind}"/>'
    place = f'<text x="{x + 8:g}" y="{y + height - 10:g}" class="{module}">{escape(name)}</text>'
    return "\n".join([rect, *written, place])


def _arrow(start: float, y: float, end: float) -> str:
    return (
        f'<path d="M{start:g} {y:g}H{end - 5:g}"/><path class="tip" d="M{end:g} {y:g}l-7 -4.5v9z"/>'
    )


def _return(right: float) -> str:
    """From the results that enter ``twin.yaml`` back to it."""
    rows = [list(WAYS).index(room) for room in RETURN]
    line = right + 14
    stubs = "".join(
        f'<path d="M{right - GAP:g} {TOP + row * STEP + HEIGHT / 2:g}H{line:g}"/>' for row in rows
    )
    low, high = TOP + max(rows) * STEP + HEIGHT / 2, 100
    return (
        f"{stubs}<path d='M{line:g} {low:g}V{high:g}H{LEFT + 60:g}V92'/>"
        f'<path class="tip" d="M{LEFT + 60:g} 85l-4.5 7h9z"/>'
    )


PICTURES = {"questions.svg": questions(), "ways.svg": ways()}

if __name__ == "__main__":
    for name, text in PICTURES.items():
        (IMAGES / name).write_text(text, "utf-8")
