"""Identification of contact parameters from recordings of pushing and pressing an object."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.errors import RecordingError
from pytest_twin.formats.pose_track import WrenchTrack
from pytest_twin.identification.contact.pushes import push_of
from pytest_twin.identification.contact.restitution import restitution
from pytest_twin.realization.free_body import FreeBody, poses_of

sys.path.append(str(Path(__file__).parents[1] / "formats"))
import sensor_bags

pytestmark = pytest.mark.usefixtures("commands_in_process")

MASS, FRICTION, HALF, OFFSET = 0.4, 0.32, 0.05, 0.0012
START = 1_700_000_000_000_000_000


def box(friction: float, half: float, timestep: float = 0.004, surface: str = "") -> str:
    return f"""<mujoco><option timestep="{timestep}" cone="elliptic"/><worldbody>
      <geom name="table" type="plane" size="5 5 0.1"/>
      <body name="cube" pos="0 0 {HALF}"><freejoint/>
        <inertial pos="0 0 0" mass="{MASS}" diaginertia="7e-4 7e-4 7e-4"/>
        <geom name="faces" type="box" size="{half} {half} {half}" friction="{friction}"
          priority="1" {surface}/>
      </body></worldbody></mujoco>"""


def force_at(time: float, seed: int) -> np.ndarray:
    """Force, N, along the surface that accelerates the box, keeps it sliding and then ends."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    share = np.interp(time, [0.02, 0.09, 0.16, 0.2, 0.34, 0.36], [0.0, 1.6, 1.6, 1.0, 1.0, 0.0])
    return FRICTION * MASS * 9.81 * share * np.array([np.cos(angle), np.sin(angle), 0.0])


def press_at(time: float, seed: int) -> np.ndarray:
    """Downward force, N, at two levels that are multiples of the weight of the box."""
    first, second = ((2, 5), (4, 1), (1, 6), (3, 6))[seed]
    levels = [0.0, first, first, second, second, 0.0]
    share = np.interp(time, [0.1, 0.12, 0.35, 0.37, 0.5, 0.52], levels)
    return np.array([0.0, 0.0, -MASS * 9.81 * share])


def record_box(
    path: Path,
    seed: int,
    frame: str,
    acting: Callable[[float, int], np.ndarray] = force_at,
    surface: str = "",
    seconds: float = 0.46,
) -> None:
    """Write poses at 100 Hz and forces at 500 Hz of a box simulated with a 0.25 ms step."""
    rng = np.random.default_rng(100 + seed)
    model = mujoco.MjModel.from_xml_string(box(FRICTION, HALF + OFFSET, 0.00025, surface))
    data = mujoco.MjData(model)
    data.qpos[2] = HALF + OFFSET
    mujoco.mj_step(model, data, nstep=4000)
    start, poses, wrenches = data.time, [], []
    for tick in range(round(seconds / 0.00025)):
        time = data.time - start
        force = acting(time, seed)
        data.xfrc_applied[1, :3] = force
        if tick % 8 == 0:
            own = data.xmat[1].reshape(3, 3).T @ force if frame == "cube" else force
            noise = 0.02 * rng.normal(size=3)
            wrenches.append([START + round(1e9 * time), *(own + noise), 0.0, 0.0, 0.0])
        if tick % 40 == 0:
            turn = data.qpos[[4, 5, 6, 3]] + 1e-4 * rng.normal(size=4)
            place = data.qpos[:3] + 5e-5 * rng.normal(size=3)
            poses.append([START + round(1e9 * time), *place, *(turn / np.linalg.norm(turn))])
        mujoco.mj_step(model, data)
    tables = {
        "/object": (sensor_bags.POSE, np.array(poses, dtype=object)),
        "/push": (sensor_bags.WRENCH, np.array(wrenches, dtype=object)),
    }
    sensor_bags.write(
        path,
        {
            topic: (kind, [int(v) for v in rows[:, 0]], rows[:, 1:].astype(float))
            for topic, (kind, rows) in tables.items()
        },
        frame=frame,
    )


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("pushes")
    (folder / "box.xml").write_text(box(0.8, HALF))
    for seed in range(4):
        record_box(folder / f"{seed}.mcap", seed, "cube" if seed % 2 else "world")
    files = [str(folder / f"{seed}.mcap") for seed in range(4)]
    status = cli.main(
        ["identify", str(folder / "box.xml"), *files[:3], "--held-out", files[3],
         "--pose-topic", "/object", "--wrench-topic", "/push", "--out", str(folder / "contact")]
    )  # fmt: skip
    return status, json.loads((folder / "contact/identification.json").read_text())


def test_pushes_identify_friction_and_contact_offset(pushed: Any) -> None:
    status, document = pushed
    assert status == 0
    friction = document["parameters"]["cube.contact_friction"]
    assert friction["value"] == pytest.approx(FRICTION, rel=0.05)
    assert friction["ci95"][0] - 0.01 <= FRICTION <= friction["ci95"][1] + 0.01
    held = document["held_out"]["cube"]
    assert held["toss_position"] < 0.3 * held["toss_position_nominal"]


def test_contact_damping_is_reported_as_unobservable_from_pushes(pushed: Any) -> None:
    _, document = pushed
    assert "cube.contact_damping" not in document["parameters"]
    assert any("contact_damping" in one["expression"] for one in document["unobservable"])


@pytest.mark.nightly
def test_presses_identify_stiffness_and_contact_offset_but_not_friction(tmp_path: Path) -> None:
    stiffness = 150.0
    (tmp_path / "box.xml").write_text(box(0.8, HALF))
    files = [tmp_path / f"{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(files):
        record_box(path, seed, "world", press_at, f'solref="-{stiffness} -15"', seconds=0.7)
    status = cli.main(
        ["identify", str(tmp_path / "box.xml"), *map(str, files[:3]), "--held-out", str(files[3]),
         "--pose-topic", "/object", "--wrench-topic", "/push", "--out", str(tmp_path / "contact")]
    )  # fmt: skip
    document = json.loads((tmp_path / "contact/identification.json").read_text())
    assert status == 0
    found = document["parameters"]
    for name, true in (("stiffness", stiffness), ("offset", OFFSET)):
        low, high = found[f"cube.contact_{name}"]["ci95"]
        assert low <= true <= high, name
    assert found["cube.contact_stiffness"]["value"] == pytest.approx(stiffness, rel=0.4)
    assert "cube.contact_friction" not in found
    (friction,) = (o for o in document["unobservable"] if o["expression"].endswith("_friction (on "
                   "the scales of the search)"))  # fmt: skip
    assert friction["motion"].startswith("push the object along the surface so that it slides")


@pytest.mark.parametrize(("stiffness", "damping"), [(1e5, 30.0), (1e5, 200.0), (1e5, 500.0)])
def test_the_computed_restitution_agrees_with_a_simulated_ball(
    stiffness: float, damping: float
) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0" timestep="1e-5"/><worldbody>
        <geom type="plane" size="1 1 1"/><body pos="0 0 0.1"><freejoint/><geom size="0.05" mass="1"
        solref="{-stiffness} {-damping}" solimp="0.999 0.999 0.001" priority="1" condim="1"/>
        </body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qvel[2] = -1.0
    mujoco.mj_step(model, data, nstep=20_000)
    assert restitution(stiffness, damping) == pytest.approx(data.qvel[2], abs=0.01)


def test_an_eccentric_push_rotates_the_object_as_in_the_closed_form() -> None:
    """A force acts on a free body with a lever arm to its centre of mass."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option gravity="0 0 0" timestep="0.001"/><worldbody><geom type="plane"
        size="1 1 1"/><body name="bar" pos="0 0 5"><freejoint/><inertial pos="0.1 0 0" mass="2"
        diaginertia="0.05 0.05 0.05"/><geom size="0.01"/></body></worldbody></mujoco>"""
    )
    body = FreeBody("bar", 1, 0, 0, (1,), (0,))
    state = np.array([0.0, 0.0, 5.0, 1.0, *np.zeros(9)])
    pose = np.tile(state[:7], (3, 1))
    wrench = WrenchTrack(
        "bar", np.array([0.0, 1.0]), np.tile([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], (2, 1))
    )
    centre = np.array([0.1, 0.0, 0.0])
    push = push_of(wrench, body, centre, np.array([0.0, 0.5, 1.0]), pose, Path("a.mcap"))
    times = np.array([[0.2]])
    (found,) = poses_of([model], body, state[None], times, [(push.time, push.values)])
    # The force acts at the origin, 0.1 m before the centre of mass: torque 0.05 N*m about y.
    angle = 0.5 * (0.05 / 0.05) * 0.2**2
    assert 2.0 * np.arcsin(found[0, 0, 5]) == pytest.approx(angle, rel=0.02)


def test_a_wrench_in_the_frame_of_the_tool_is_refused() -> None:
    wrench = WrenchTrack("tool0", np.array([0.0, 1.0]), np.ones((2, 6)))
    pose = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1))
    body = FreeBody("cube", 1, 0, 0, (1,), (0,))
    with pytest.raises(RecordingError, match=r"neither the object nor the world.*'cube'"):
        push_of(wrench, body, np.zeros(3), np.array([0.0, 1.0]), pose, Path("a.mcap"))
