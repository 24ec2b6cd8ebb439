"""Detect the corners of a target in images, and give the reason where an image is not usable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.finders import Found, find
from pytest_twin.calibration.boards.homography import fit_homography, project
from pytest_twin.calibration.boards.image_file import Grey, read_grey
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.boards.sharpness import blur_px, image_blur_px
from pytest_twin.calibration.boards.target import Target
from pytest_twin.errors import TwinError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.time_limit import current_limit

LEAST_SHARE = 0.4
"""Smallest fraction of the target's corners that must be detected. Fewer corners determine the tilt
of the plane poorly."""

FEWEST_CORNERS = 6
"""A pose needs four corners; two more make it possible to check the fit."""

MOST_BLUR = 0.06
"""Standard deviation of the blur, as a fraction of a square's edge, above which corners are not
usable. The sub-pixel refinement uses a window of a sixth of a square around a corner and finds no
edge above this blur. A sharp lens has a blur of 0.6 px, so the smallest usable squares have 10
px."""

BLUR_AGAINST_OTHERS = 3.0
"""An image is rejected as moving or out of focus if its blur in px exceeds the median of all images
by this factor."""

LEAST_BLUR_PX = 2.0
"""Blur up to this standard deviation does not shift corners and is always accepted."""

BLURRED_IMAGE_PX = 4.0
"""Blur of the sharpest edges of a whole image above which the image is reported as blurred. A lens
in focus has less than 1.5 px, an image without fine detail up to 3 px."""

MOST_MISFIT = 0.06
"""Median distance between detected corners and the drawing of the board, as a fraction of a
square's edge, above which the image shows another board. Lens distortion of 20 % across the image
displaces the corners by less."""

_COARSER = (2, 4)
"""Factors by which an image without a target is reduced and searched again, to find out whether it
is blurred."""

_THREADS = 2
"""Number of images that are processed at the same time."""


@dataclass(frozen=True)
class Detection:
    """Corners of a target in one image.

    Attributes:
        size: width and height, px.
        corner_ids: (n,) indices into ``Target.board_points()``.
        pixels: (n, 2) positions in the image, px; the centre of the first pixel is (0, 0).
        board_points: (n, 3) positions in the target's frame, m.
        corners: number of corners of the whole target.
        sharpness: standard deviation of the blur of the target's edges, px; NaN without a target.
        rejected: why the image is not usable; empty where it is.
    """

    image: str
    size: tuple[int, int]
    corner_ids: np.ndarray
    pixels: FloatArray
    board_points: FloatArray
    corners: int
    sharpness: float
    rejected: str = ""

    @property
    def is_usable(self) -> bool:
        """Whether corners of this image can be used."""
        return not self.rejected


def detect_files(
    paths: Sequence[Path],
    target: Target,
    names: Sequence[str] | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Detection]:
    """Detect the target in image files; one detection for each file, in the same order.

    A missing or damaged file gives a rejected detection with the reader's error message. An image
    that the time limit leaves unread is rejected too.

    Args:
        target: what to look for.
        names: names of the detections; by default the file names.
        progress: called with the fraction of the images that were searched.

    Raises:
        LimitError: more files than ``limits.IMAGES`` allows.
        SpecError: OpenCV is not installed.
    """
    require_at_most(
        len(paths),
        limits.IMAGES.files_count,
        "too many images",
        unit="images",
        path=paths[0].parent,
    )
    opencv()
    names = [path.name for path in paths] if names is None else names

    limit = current_limit()

    def one(path: Path, name: str) -> Detection:
        if limit.is_over():
            return _no_detection(name, (0, 0), target, "not read: the time was over")
        try:
            image = read_grey(path)
        except TwinError as error:
            return _no_detection(name, (0, 0), target, str(error))
        return detect(image, target, name)

    with ThreadPoolExecutor(_THREADS) as pool:
        found = []
        for detection in pool.map(one, paths, names):
            found.append(detection)
            progress(len(found) / len(paths))
    return without_blurred(found)


def detect(image: Grey, target: Target, name: str = "") -> Detection:
    """Detect the target in one image, without comparison with other images.

    Args:
        image: (height, width) grey values.
        target: what to look for.
    """
    size = (image.shape[1], image.shape[0])
    found = find(image, target)
    if len(found.ids) < 4:
        return _no_detection(name, size, target, _reason_for_no_target(image, target, found))
    points = target.board_points()[found.ids]
    blur = blur_px(image, target, found.ids, found.pixels)
    detection = Detection(
        name, size, found.ids, found.pixels, points, target.corners, blur, found.problem
    )
    return (
        detection if found.problem else replace(detection, rejected=_rejection(detection, target))
    )


def without_blurred(detections: Sequence[Detection]) -> list[Detection]:
    """Return the detections; those with far more blur than the others are rejected."""
    blurs = [d.sharpness for d in detections if d.is_usable]
    if len(blurs) < 3:
        return list(detections)
    usual = float(np.nanmedian(blurs))
    most = max(BLUR_AGAINST_OTHERS * usual, LEAST_BLUR_PX)
    return [
        replace(
            d,
            rejected=f"blurred: the edges' blur is {d.sharpness:.1f} px, "
            f"in the other images {usual:.1f} px",
        )
        if d.is_usable and d.sharpness > most
        else d
        for d in detections
    ]


def _rejection(detection: Detection, target: Target) -> str:
    """Reason why a detected target is not usable; empty where it is usable."""
    count, all_corners = len(detection.corner_ids), detection.corners
    if count < max(FEWEST_CORNERS, LEAST_SHARE * all_corners):
        why = f"target found in {count} of {all_corners} corners"
        blurred = detection.sharpness > LEAST_BLUR_PX
        return f"{why}; the edges' blur is {detection.sharpness:.1f} px" if blurred else why
    plane = detection.board_points[:, :2]
    if np.linalg.matrix_rank(plane - plane.mean(axis=0), tol=1e-6 * target.square) < 2:
        return f"the {count} corners that were found lie on one line"
    homography = fit_homography(plane, detection.pixels)
    if homography is None:
        return "the corners do not lie as on the target: check squares and dictionary"
    off = np.linalg.norm(project(homography, plane) - detection.pixels, axis=1)
    edge = square_px(homography, target, plane.mean(axis=0))
    if np.median(off) > MOST_MISFIT * edge:
        return (
            f"the corners lie {np.median(off):.1f} px off the target's plan, with squares of "
            f"{edge:.0f} px: check squares and dictionary"
        )
    if detection.sharpness > MOST_BLUR * edge:
        return (
            f"blurred: the edges' blur is {detection.sharpness:.1f} px, with squares of "
            f"{edge:.0f} px"
        )
    return ""


def square_px(homography: FloatArray, target: Target, at: FloatArray) -> float:
    """Edge length of a square in the image near a position on the board, px."""
    edge = target.marker if target.kind == "apriltag_grid" else target.square
    around = at + edge * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    origin, x, y = project(homography, around)
    return float(min(np.linalg.norm(x - origin), np.linalg.norm(y - origin)))


def _reason_for_no_target(image: Grey, target: Target, found: Found) -> str:
    """Reason why no target was found: blur, or the finder's message."""
    if found.problem:
        return found.problem
    cv2 = opencv()
    for factor in _COARSER:
        shape = (image.shape[1] // factor, image.shape[0] // factor)
        if min(shape) < 64:
            break
        coarse = find(cv2.resize(image, shape, interpolation=cv2.INTER_AREA), target)
        if len(coarse.ids) >= max(FEWEST_CORNERS, LEAST_SHARE * target.corners):
            blur = blur_px(image, target, coarse.ids, factor * (coarse.pixels + 0.5) - 0.5)
            return (
                f"blurred: the target is found at 1/{factor} of the resolution only; "
                f"the edges' blur is {blur:.1f} px"
            )
    blur = image_blur_px(image)
    if not np.isfinite(blur):
        return "no target found; the image has no edges"
    kind = "blurred: " if blur > BLURRED_IMAGE_PX else ""
    return f"{kind}no target found; the sharpest edges have a blur of {blur:.1f} px"


def _no_detection(name: str, size: tuple[int, int], target: Target, why: str) -> Detection:
    empty = np.zeros(0, dtype=int)
    return Detection(
        name, size, empty, np.zeros((0, 2)), np.zeros((0, 3)), target.corners, float("nan"), why
    )
