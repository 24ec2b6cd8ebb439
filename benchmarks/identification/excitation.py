"""Expected covariance of D-optimal motion against random motion, and against published motion.

    python benchmarks/identification/excitation.py [--flobaroid CHECKOUT]
        [--out JSON] [ROBOT ...]

Random motion is a Fourier series with the same basis functions, limits and length and with random
coefficients, scaled up to the limits. The table has the median of 20. Published motions are the
excitation run of a Staubli TX40 (data of FIGAROH, through TWIN_RECORDINGS), and the optimized
motion of a KUKA LWR4 from FloBaRoID (github.com/kjyv/FloBaRoID,
model/kuka_lwr4.urdf.trajectory_opt_1.npz). Our motion has the same length and stays within the
range, largest speed, largest acceleration and frequencies of the published one.

FIGAROH publishes neither log det nor predicted deviations of its optimized motions, so only the
recorded motion can be compared.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal
import tx40_files

from pytest_twin.excitation.approved_limits import ApprovedLimits, JointLimits, Stop
from pytest_twin.excitation.d_optimal import Design
from pytest_twin.excitation.motion import JointStates
from pytest_twin.excitation.noise import noise_of
from pytest_twin.excitation.prediction import of_base
from pytest_twin.excitation.read_limits import movable_joints
from pytest_twin.identification.regressor.base_parameters import structural_base
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.joint_limits import model_effort, model_range
from pytest_twin.realization.loading import load
from pytest_twin.realization.model import Realization

RANDOM = 20
RATE = 100.0
ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", ("panda_finger",)),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", ()),
    "z1": ("z1_description/urdf/z1.urdf", ("jointGripper",)),
    "talos arm": ("talos_data/robots/talos_left_arm.urdf", ("gripper",)),
    "so101": ("so_arm_description/urdf/so101.urdf", ("gripper",)),
}
MJCF = """\
<mujoco model="arm"><compiler angle="radian"/><worldbody><body>
<joint name="yaw" axis="0 0 1" range="-2.5 2.5"/><geom type="capsule" size=".03" fromto="0 0 0 .3 0 .05" mass="1.2"/>
<body pos=".3 0 .05"><joint name="lift" axis="0 1 0" range="-2 2"/><geom type="capsule" size=".03" fromto="0 0 0 .25 0 0" mass=".7"/>
<body pos=".25 0 0"><joint name="elbow" axis="0 1 0" range="-2 2"/><geom type="capsule" size=".03" fromto="0 0 0 .15 .05 0" mass=".3"/>
</body></body></body></worldbody></mujoco>
"""  # noqa: E501


def robots_folder() -> Path:
    """Return models of example-robot-data."""
    import pinocchio

    for parent in Path(pinocchio.__file__).parents:
        found = parent / "share" / "example-robot-data" / "robots"
        if found.is_dir():
            return found
    raise SystemExit("example-robot-data is not installed: pip install pytest-twin[test]")


def approved(
    joints: list[JointLimits], duration: float, band: tuple[float, float]
) -> ApprovedLimits:
    """Limits of a robot without obstacles."""
    return ApprovedLimits(
        "a benchmark", ("inertia",), duration, RATE, band, 0.0, tuple(joints), (), None, 1e9,
        Stop(1, 0.0, "none"), {},
    )  # fmt: skip


def from_model(realization: Realization, left_out: tuple[str, ...]) -> ApprovedLimits:
    """The limits are 80 % of each joint's range, half its speed, and this speed within 0.25 s."""
    joints = []
    for name in movable_joints(realization):
        if name.startswith(left_out) and left_out:
            continue
        own = model_range(realization.model, realization.joint_index(name)) or [-2.5, 2.5]
        low, high = max(own[0], -2.5), min(own[1], 2.5)
        middle, half = 0.5 * (low + high), 0.4 * (high - low)
        speed = 0.5 * min(realization.velocity_limit.get(name) or 4.0, 4.0)
        effort = model_effort(realization, name)
        most = 50.0 if effort is None else min(-effort[0], effort[1])
        joints.append(
            JointLimits(
                name, middle - half, middle + half, speed, 4.0 * speed, most, middle, is_slide=False
            )
        )
    return approved(joints, 20.5, (0.1, 1.0))


def worst(
    realization: Realization, limits: ApprovedLimits, drawn: JointStates
) -> tuple[float, float]:
    """Return log det of the information, and the largest relative deviation in percent.

    Parameters that are small are left out."""
    regressor = Regressor(realization, limits.names)
    base = structural_base(regressor)
    noise = noise_of(realization, limits)
    matrix = regressor.matrix(drawn.position, drawn.velocity, drawn.acceleration)
    own = (base.matrix(matrix) / noise.effort[:, None]).reshape(-1, len(base))
    sizes = np.linalg.norm(own, axis=0)
    singular = np.linalg.svd(own / sizes, compute_uv=False)
    found = of_base("inertia", base, regressor, matrix, limits, noise)
    relative = [one.relative_std for one in found if one.relative_std and not one.is_small]
    value = 2.0 * float(np.log(singular).sum() + np.log(sizes).sum())
    return value, 100.0 * max(relative, default=math.nan)


def compared(
    name: str,
    realization: Realization,
    limits: ApprovedLimits,
    theirs: JointStates | None,
) -> dict:
    """Compare our motion with random motion, and with the published one if it exists."""
    regressor = Regressor(realization, limits.names)
    base = structural_base(regressor)
    std = noise_of(realization, limits).effort
    design = Design(limits, regressor, base, std)
    since = time.process_time()
    best = design.optimum(1)
    seconds = time.process_time() - since
    ours = worst(realization, limits, design.drawn(best.coefficients))
    random = [
        worst(realization, limits, design.drawn(design.random(seed))) for seed in range(RANDOM)
    ]
    middle = [float(np.median([one[i] for one in random])) for i in (0, 1)]
    found: dict[str, Any] = {
        "robot": name,
        "joints": len(limits.joints),
        "base_parameters": len(base),
        "log_det": {"ours": ours[0], "random": middle[0], "best_random": max(r[0] for r in random)},
        "worst_percent": {
            "ours": ours[1], "random": middle[1], "best_random": min(r[1] for r in random),
        },
        "mean_deviation_ratio": {"random": math.exp((ours[0] - middle[0]) / 2 / len(base))},
        "seconds": seconds,
    }  # fmt: skip
    if theirs is not None:
        published = worst(realization, limits, theirs)
        found["log_det"]["published"] = published[0]
        found["worst_percent"]["published"] = published[1]
        ratio = math.exp((ours[0] - published[0]) / 2 / len(base))
        found["mean_deviation_ratio"]["published"] = ratio
    return found


def envelope(
    realization: Realization, names: tuple[str, ...], drawn: JointStates
) -> ApprovedLimits:
    """Return the limits that a motion uses."""
    joints = []
    for at, name in enumerate(names):
        low, high = float(drawn.position[:, at].min()), float(drawn.position[:, at].max())
        effort = model_effort(realization, name)
        joints.append(
            JointLimits(
                name, low, high, float(np.abs(drawn.velocity[:, at]).max()),
                float(np.abs(drawn.acceleration[:, at]).max()),
                50.0 if effort is None else min(-effort[0], effort[1]),
                float(np.clip(drawn.position[0, at], low + 1e-3, high - 1e-3)), is_slide=False,
            )
        )  # fmt: skip
    seconds = float(drawn.time[-1])
    frequency, power = scipy.signal.periodogram(drawn.velocity, RATE, axis=0)
    share = np.cumsum(power.sum(axis=1)) / power.sum()
    highest = float(frequency[np.searchsorted(share, 0.99)])
    return approved(joints, seconds, (1.0 / (seconds - 0.5), highest))


def flobaroid(checkout: Path) -> tuple[Realization, tuple[str, ...], JointStates]:
    """Return the published motion of the KUKA LWR4, at 100 Hz."""
    realization = without_meshes(checkout / "model" / "kuka_lwr4.urdf")
    file = np.load(checkout / "model" / "kuka_lwr4.urdf.trajectory_opt_1.npz", allow_pickle=False)
    rows = slice(None, None, round(float(file["frequency"]) / RATE))
    drawn = JointStates(
        *(file[k][rows] for k in ("times", "positions", "velocities", "accelerations"))
    )
    return realization, movable_joints(realization), drawn


def without_meshes(urdf: Path) -> Realization:
    """Load a robot without shapes, because the package with its meshes is not available."""
    with tempfile.TemporaryDirectory() as scratch:
        return load(without_meshes_file(urdf, Path(scratch)))


def without_meshes_file(urdf: Path, out: Path) -> Path:
    """Write a robot without shapes to a folder, and return its file."""
    from lxml import etree

    tree = etree.parse(urdf, etree.XMLParser(resolve_entities=False, no_network=True))
    for link in tree.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    bare = out / urdf.name
    tree.write(bare)
    return bare


def tx40(source: Path) -> tuple[Realization, tuple[str, ...], JointStates]:
    """Return the recorded joint motion of the TX40, low-passed as by its authors, at 100 Hz."""
    realization = without_meshes(source / "tx40.urdf")
    motor = tx40_files.read_table(source / "motor_positions.csv.gz")
    turned = motor / np.array(tx40_files.GEARS)
    turned[:, 5] -= turned[:, 4]
    zeros = np.array([tx40_files.ZEROS.get(name, 0.0) for name in tx40_files.JOINTS])
    sections = scipy.signal.butter(4, 10.0, fs=tx40_files.RATE, output="sos")
    position = scipy.signal.sosfiltfilt(sections, turned + zeros, axis=0)
    velocity = np.gradient(position, 1.0 / tx40_files.RATE, axis=0)
    acceleration = np.gradient(velocity, 1.0 / tx40_files.RATE, axis=0)
    rows = slice(None, None, round(tx40_files.RATE / RATE))
    time_ = np.arange(len(position)) / tx40_files.RATE
    drawn = JointStates(time_[rows], position[rows], velocity[rows], acceleration[rows])
    return realization, tx40_files.JOINTS, drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*", help="some of the robots; all by default")
    parser.add_argument("--flobaroid", type=Path, help="a checkout of github.com/kjyv/FloBaRoID")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    args = parser.parse_args()
    cases: list[tuple[str, Any]] = []
    folder = robots_folder()
    for name, (file, left_out) in ROBOTS.items():
        cases.append(
            (name, lambda f=file, o=left_out: (r := load(folder / f), from_model(r, o), None))
        )
    cases.append(("arm (MJCF)", lambda: _mjcf()))
    source = tx40_files.folder()
    if source is not None:
        cases.append(("tx40 (FIGAROH)", lambda: _published(*tx40(source))))
    if args.flobaroid is not None:
        cases.append(("kuka (FloBaRoID)", lambda: _published(*flobaroid(args.flobaroid))))
    found = []
    print(
        "| robot | joints | base parameters | log det ours, random, published | mean deviation, "
        "random / ours, published / ours | worst deviation [%] ours, random, published | CPU [s] |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, make in cases:
        if args.robots and name.split(" ")[0] not in args.robots and name not in args.robots:
            continue
        realization, limits, theirs = make()
        one = compared(name, realization, limits, theirs)
        found.append(one)
        print(_line(one), flush=True)
        if args.out is not None:
            args.out.write_text(json.dumps(found, indent=2) + "\n")


def _stated(
    realization: Realization, left_out: tuple[str, ...]
) -> tuple[Realization, ApprovedLimits, None]:
    return realization, from_model(realization, left_out), None


def _mjcf() -> tuple[Realization, ApprovedLimits, None]:
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "arm.xml"
        path.write_text(MJCF)
        return _stated(load(path), ())


def _published(
    realization: Realization, names: tuple[str, ...], drawn: JointStates
) -> tuple[Realization, ApprovedLimits, JointStates]:
    return realization, envelope(realization, names, drawn), drawn


def _line(one: dict) -> str:
    def three(values: dict, digits: str) -> str:
        return ", ".join(
            format(values[k], digits) for k in ("ours", "random", "published") if k in values
        )

    return (
        f"| {one['robot']} | {one['joints']} | {one['base_parameters']} | "
        f"{three(one['log_det'], '.1f')} | {three(one['mean_deviation_ratio'], '.2f')} | "
        f"{three(one['worst_percent'], '.3g')} | {one['seconds']:.0f} |"
    )


if __name__ == "__main__":
    main()
