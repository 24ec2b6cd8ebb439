"""Problems whose inputs are recordings outside of the project."""

from __future__ import annotations

import csv
import gzip
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frozen.problem import Inputs, Problem, outside

sys.path[:0] = [str(Path(__file__).parents[1] / folder) for folder in ("identification", "real")]

MACHINES, PROBLEMS = "TWIN_RECORDINGS", "TWIN_PROBLEMS"
"""Environment variables: folder of recordings of real machines, and of small made problems."""
GAINS = (100, 200, 400, 800)
XL330_LOGS = ("sin_sin", "sin_time_square", "up_and_down", "lift_and_drop")
PUBLISHED_LOGS = XL330_LOGS[:3]
LIMITED = ("none", "default", "45s")
Effects = Sequence[tuple[str, str | None, Mapping[str, float]]]

TABLE: Mapping[str, Effects] = {
    "delay": [("command_delay", "j", {"delay": 0.02})],
    "coulomb": [("coulomb_friction", "j", {"coulomb": 0.4})],
    "gain": [("controller_gain", "j", {"stiffness_error": 42.0 / 60.0 - 1.0})],
    "backlash": [("backlash", "j", {"gap": 0.03})],
    "torque": [("effort_scale", "j", {"scale_error": 0.35})],
    "sign": [("encoder_scale", "j", {"scale_error": -2.0})],
    "ok": [],
}
"""Case of one joint -> what its model lacks."""
SAME_ON_ONE_JOINT = {"command_delay": [["sensor_delay", None]]}
"""Effect -> effects, with their joint, that predict the same motion of a robot with one joint."""
MADE: Mapping[str, Effects] = {
    "interpolated_lag": [("actuator_lag", "j1", {"time_constant": 0.012})],
    "taken_for_a_simulation": [
        ("controller_gain", "j3", {"stiffness_error": -0.4, "damping_error": -0.2})
    ],
    "tilted_base": [("base_tilt", None, {})],
    "late_command": [("command_delay", "j1", {"delay": 0.018})],
    "motor_constant": [("torque_constant", "j1", {"relative_error": -0.14})],
}


def problems() -> Iterator[Problem]:
    """Yield all problems from recordings."""
    for name in TABLE:
        yield Problem(f"table/{name}", "diagnose", partial(_table, name), LIMITED)
    yield Problem("made/two_frictions", "diagnose", _two_frictions, LIMITED)
    for name in MADE:
        yield Problem(f"made/{name}", "diagnose", partial(_made, name))
    for part in ("whole", "cut", "cut_commands_lead"):
        yield Problem(f"made/in_motion_{part}", "diagnose", partial(_in_motion, part))
    yield Problem("emps/carriage", "diagnose", _emps)
    for gain in GAINS:
        yield Problem(f"xl330/without_{gain}", "diagnose", partial(_xl330, gain))
    yield Problem("so101/excerpts", "diagnose", partial(_so101, 8.0))
    yield Problem("so101/whole", "diagnose", partial(_so101, None))
    yield Problem("effort/tx40", "identify", _tx40, ("default",))
    yield Problem("effort/panda_100_hz", "identify", _panda, ("default",))
    for angle in ("rounded", "exact"):
        yield Problem(f"effort/nova5_{angle}", "identify", partial(_nova5, angle), ("default",))
    for order in ("r", "p"):
        yield Problem(f"effort/order_{order}", "identify", partial(_order, order), ("default",))


def truth_of(effects: Effects) -> dict[str, Any]:
    """Return a truth as ``family_score.py`` reads it."""
    return {
        "effects": [
            {
                "effect": effect, "joint": joint, "parameters": dict(parameters),
                "visibility": 100.0, "equivalents": SAME_ON_ONE_JOINT.get(effect, []),
            }
            for effect, joint, parameters in effects
        ],
        "background": [],
    }  # fmt: skip


def _table(name: str, folder: Path) -> Inputs:
    source = outside(PROBLEMS, "programme", "table")
    fit = [source / name / f"r{k}.csv" for k in (0, 1)]
    held_out = [p for p in (source / name / "r2.csv",) if p.exists()]
    return Inputs(source / "pend.xml", fit, held_out, truth_of(TABLE[name]))


def _two_frictions(folder: Path) -> Inputs:
    source = outside(PROBLEMS, "diagnosis", "two_frictions")
    lacks = [
        ("viscous_friction", "elbow", {"coefficient": 0.6}),
        ("coulomb_friction", "elbow", {"coulomb": 0.6}),
    ]
    return Inputs(
        source / "arm.xml", [source / "good.csv", source / "good_b.csv"],
        [source / "good_c.csv"], truth_of(lacks),
    )  # fmt: skip


def _made(name: str, folder: Path) -> Inputs:
    source = outside(PROBLEMS, "diagnosis", name)
    recordings = sorted((source / "recordings").glob("*.mcap"))
    return Inputs(source / "model.xml", recordings, truth=truth_of(MADE[name]))


def _in_motion(part: str, folder: Path) -> Inputs:
    source = outside(PROBLEMS, "reports", "28-starts-in-motion")
    files = [source / part / f"r{k}.mcap" for k in (1, 2, 3)]
    lacks = [("viscous_friction", "j1", {"coefficient": 0.8})]
    return Inputs(source / "pend.xml", files[:2], files[2:], truth_of(lacks))


def _emps(folder: Path) -> Inputs:
    source = outside(MACHINES, "emps")
    recordings = sorted((source / "recordings").glob("*.mcap"))
    known = [
        ("viscous_friction", "slide", {"coefficient": 203.5}),
        ("coulomb_friction", "slide", {"coulomb": 20.39}),
    ]
    # The published fit, which nobody knows to be complete: other findings count as background.
    forms = ("asymmetric_friction", "directional_viscous_friction", "quadratic_drag")
    background = [{"effect": e, "joint": "slide", "parameters": {}} for e in forms]
    truth = truth_of(known) | {"background": background}
    return Inputs(source / "model.xml", recordings, truth=truth)


def _xl330(gain: int, folder: Path) -> Inputs:
    source = outside(MACHINES, "xl330")
    paths = {g: [source / "recordings" / f"kp{g}_{log}.mcap" for log in XL330_LOGS] for g in GAINS}
    fit = [p for g in GAINS if g != gain for p in paths[g]]
    return Inputs(source / "twin.yaml", fit, paths[gain])


def _so101(seconds: float | None, folder: Path) -> Inputs:
    import so101

    source = outside(MACHINES, "so101")
    everything = sorted(p.stem for p in (source / "recordings").glob("*.mcap"))
    rest = [n for n in everything if n not in (*so101.FIT, *so101.HELD_OUT)]

    def recordings(names: Sequence[str], role: str) -> list[Path]:
        if seconds is None:
            return [source / "recordings" / f"{n}.mcap" for n in names]
        return [so101.excerpt(n, role, seconds, folder / "excerpts") for n in names]

    return Inputs(
        source / "model.xml", recordings(so101.FIT, "fit"),
        recordings(so101.HELD_OUT, "held_out"), others=recordings(rest, "held_out"),
    )  # fmt: skip


def _tx40(folder: Path) -> Inputs:
    import tx40_files

    folder.mkdir(parents=True, exist_ok=True)
    paths = tx40_files.write(outside(MACHINES, "tx40"), folder)
    return Inputs(paths["twin"], [paths["fit"]], [paths["held_out"]])


def _panda(folder: Path) -> Inputs:
    from excitation import robots_folder, without_meshes_file

    source = outside(MACHINES, "panda_gaz", "exciting.csv.gz")
    with gzip.open(source, "rt") as file:
        head, *rows = list(csv.reader(file))
    rows = rows[::10]
    cut = round(0.8 * len(rows))
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in (("fit", rows[:cut]), ("held_out", rows[cut:])):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *part])
    urdf = robots_folder() / "panda_description/urdf/panda.urdf"
    return Inputs(
        without_meshes_file(urdf, folder), [folder / "fit.csv"], [folder / "held_out.csv"]
    )


def _nova5(angle: str, folder: Path) -> Inputs:
    source = outside(PROBLEMS, "programme", "rounded_urdf")
    folder.mkdir(parents=True, exist_ok=True)
    text = (source / "nova5_robot.urdf").read_text()
    if angle == "exact":
        text = text.replace("-1.57080287682252", "-1.5707963267948966")
    (folder / "nova5_robot.urdf").write_text(text)
    (folder / "twin.yaml").write_text("model: nova5_robot.urdf\n")
    for name in ("fourier_fit", "grid_fit", "fourier_held_out"):
        shutil.copyfile(source / f"{name}.csv", folder / f"{name}.csv")
    return Inputs(
        folder / "twin.yaml", [folder / "fourier_fit.csv", folder / "grid_fit.csv"],
        [folder / "fourier_held_out.csv"],
    )  # fmt: skip


def _order(order: str, folder: Path) -> Inputs:
    source = outside(PROBLEMS, "programme", "order_of_names")
    files = [source / f"{order}{k}.mcap" for k in (1, 2, 3)]
    return Inputs(source / "model.xml", files[:2], files[2:])
