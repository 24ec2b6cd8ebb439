"""Read image files within limits on their size."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import read_bytes

Grey = NDArray[np.uint8]

_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM", "WEBP")


def read_grey(path: Path) -> Grey:
    """(height, width) grey values of an image file in the sensor's orientation (EXIF is ignored).

    Raises:
        PathError: the file is missing, a link, or no regular file.
        LimitError: the file has more bytes or pixels than ``limits.IMAGES`` allows.
        FormatError: not an image of a known format, or a damaged one.
    """
    from PIL import Image

    bounds = limits.IMAGES
    data = read_bytes(path, bounds.file_bytes)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                width, height = image.size
                if width * height > bounds.pixels_count:
                    raise Image.DecompressionBombError
                return _grey(image)
    except Image.DecompressionBombError:
        raise LimitError(
            "image is too large", path=path, expected=f"at most {bounds.pixels_count} pixels"
        ) from None
    except Exception as error:  # decoders raise errors of every kind on damaged files
        raise FormatError(
            f"no readable image: {error}", path=path, expected=", ".join(_FORMATS)
        ) from None


def _grey(image: object) -> Grey:
    """Convert to 8-bit grey values; 16-bit values are scaled by the range that the image uses."""
    from PIL import Image

    assert isinstance(image, Image.Image)
    if not image.mode.startswith(("I", "F")):
        return np.asarray(image.convert("L"), dtype=np.uint8)
    values = np.nan_to_num(np.asarray(image, dtype=np.float64))
    low, high = float(values.min()), float(values.max())
    scale = 255.0 / (high - low) if high > low else 0.0
    return np.asarray(np.round(scale * (values - low)), dtype=np.uint8)
