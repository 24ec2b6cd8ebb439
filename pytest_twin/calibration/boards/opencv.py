"""Import OpenCV when the first image is read."""

from __future__ import annotations

from functools import cache
from typing import Any

from pytest_twin.errors import SpecError

_INSTALL = "pip install 'pytest-twin[calibration]'"


@cache
def opencv() -> Any:
    """The module ``cv2``.

    Raises:
        SpecError: OpenCV is missing, or has no ArUco markers or no hand-eye solvers; the message
            names the package to install.
    """
    try:
        import cv2
    except ImportError:
        raise SpecError("OpenCV is not installed", where="images", expected=_INSTALL) from None
    # OpenCV 5 has no hand-eye solvers in Python; builds without contrib have no ArUco boards.
    if not (hasattr(cv2, "calibrateHandEye") and hasattr(cv2, "aruco")):
        raise SpecError(
            "this OpenCV has no hand-eye calibration or no ArUco markers",
            where="images",
            value=cv2.__version__,
            expected=f"opencv-contrib-python-headless 4.10 to 4.x: {_INSTALL}",
        )
    # Callers report failures; OpenCV would print its own messages in between.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2
