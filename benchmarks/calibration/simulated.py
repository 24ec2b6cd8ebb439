"""Simulate robots, cameras and targets with MuJoCo, for blind calibration cells.

Poses and images are computed by MuJoCo. The package's kinematics, camera model and board geometry
are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

ARM = "zyyzyzx"
"""Axes of a typical arm in its zero position; joints 2 and 3 are parallel."""

REACH_M = 1.0


@dataclass(frozen=True)
class Robot:
    """A serial robot whose base is the world's frame.

    Attributes:
        joints: names.
        text: MJCF, its last body named ``flange``.
        limits: (n, 2) rad.
    """

    joints: tuple[str, ...]
    text: str
    limits: Array


def draw_robot(rng: np.random.Generator, count: int) -> Robot:
    """Return an arm of ``count`` revolute joints with random links and offsets."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    names = tuple(f"joint{at + 1}" for at in range(count))
    opening, closing = "", ""
    for at, name in enumerate(names):
        place = [*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.7, 1.3) * REACH_M / count]
        opening += (
            f'<body name="link{at + 1}" pos="{numbers(place)}"><inertial pos="0 0 0" mass="1" '
            f'diaginertia="0.01 0.01 0.01"/><joint name="{name}" axis="{axes[ARM[at]]}" '
            'range="-2.6 2.6"/>'
        )
        closing += "</body>"
    end = [*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.05, 0.12)]
    opening += f'<body name="flange" pos="{numbers(end)}">'
    text = (
        '<mujoco model="arm"><compiler angle="radian"/><worldbody>'
        f"{opening}</body>{closing}</worldbody></mujoco>"
    )
    return Robot(names, text, np.tile([-2.6, 2.6], (count, 1)))


def flange_poses(robot: Robot, positions: Array) -> Array:
    """(rows, 4, 4) flange poses in the base, m, at true joint positions (rows, n), rad."""
    model = mujoco.MjModel.from_xml_string(robot.text)
    data = mujoco.MjData(model)
    found = np.tile(np.eye(4), (len(positions), 1, 1))
    for pose, row in zip(found, positions, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        body = data.body("flange")
        pose[:3, :3], pose[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    return found


def rigid(turn: Array, place: Array) -> Array:
    """(4, 4) of a rotation vector (rad) and a position (m)."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    found[:3, 3] = place
    return found


def noisy(rng: np.random.Generator, poses: Array, place: float, turn: float) -> Array:
    """Poses with normal noise on each coordinate, m and rad."""
    return np.array([p @ rigid(rng.normal(0.0, turn, 3), rng.normal(0.0, place, 3)) for p in poses])


def numbers(values: Array | list[float]) -> str:
    """Format numbers for XML and CSV."""
    return " ".join(repr(float(value)) for value in values)


WIDTH, HEIGHT, FIELD_OF_VIEW = 1024, 768, 45.0
FOCAL_PX = 0.5 * HEIGHT / np.tan(np.deg2rad(FIELD_OF_VIEW) / 2.0)
INTRINSICS = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": (WIDTH - 1) / 2.0, "cy": (HEIGHT - 1) / 2.0}
"""Of MuJoCo's camera: the optical axis runs through the middle of the image, px."""

SQUARES, SQUARE_M, MARKER_M, DICTIONARY = (7, 5), 0.03, 0.022, "DICT_5X5_100"
_PIXELS_PER_M, _MARGIN_M = 256 / SQUARE_M, 0.015
"""The print has 2048 by 1536 texels. Textures of other sizes are resampled with a shift of part of
a texel, which looks like a relative focal-length error of 6e-4."""


def board_images(seen: Array) -> list[NDArray[np.uint8]]:
    """Render images of a ChArUco board at (n, 4, 4) ``camera_from_target``, m.

    The board lies in the plane z = 0 of its own frame, x to the right and y down its print.
    """
    page = _printed()
    height, width = page.shape[0] / _PIXELS_PER_M, page.shape[1] / _PIXELS_PER_M
    low = -_MARGIN_M
    corners = [(low, low), (low + width, low), (low + width, low + height), (low, low + height)]
    # The last vertex lies behind the plane, because a mesh needs a volume.
    vertices = [*((x, y, 0.0) for x, y in corners), (low, low, 0.001)]
    mesh = (
        f'<mesh name="board" inertia="shell" vertex="{numbers(np.ravel(vertices))}" '
        'texcoord="0 0 1 0 1 1 0 1 0 0" face="0 2 1 0 3 2 0 1 4"/>'
    )
    scene = (
        f'<mujoco><visual><global offwidth="{WIDTH}" offheight="{HEIGHT}"/>'
        '<quality offsamples="8"/><headlight ambient="0.55 0.55 0.55" diffuse="0.4 0.4 0.4" '
        'specular="0 0 0"/></visual><asset>'
        '<texture name="print" type="2d" file="print.png"/>'
        '<material name="print" texture="print" specular="0" shininess="0" reflectance="0"/>'
        f"{mesh}</asset><worldbody>"
        '<body name="board" mocap="true"><geom type="mesh" mesh="board" material="print" '
        'contype="0" conaffinity="0"/></body>'
        f'<camera name="camera" fovy="{FIELD_OF_VIEW}" xyaxes="1 0 0 0 -1 0"/>'
        "</worldbody></mujoco>"
    )
    import cv2

    model = mujoco.MjModel.from_xml_string(
        scene, {"print.png": cv2.imencode(".png", page)[1].tobytes()}
    )
    data = mujoco.MjData(model)
    found = []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for pose in seen:
            # The camera looks along the world's z: xyaxes above turn MuJoCo's camera, which looks
            # along its own -z with y up, into one with y down.
            data.mocap_pos[0] = pose[:3, 3]
            data.mocap_quat[0] = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="camera")
            found.append(cv2.cvtColor(renderer.render(), cv2.COLOR_RGB2GRAY))
    return found


def _printed() -> NDArray[np.uint8]:
    """The board's print with a white margin."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, dictionary)
    size = [round(count * SQUARE_M * _PIXELS_PER_M) for count in SQUARES]
    margin = round(_MARGIN_M * _PIXELS_PER_M)
    grey = np.pad(board.generateImage(size), margin, constant_values=255)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
