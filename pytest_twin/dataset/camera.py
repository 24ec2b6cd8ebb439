"""Find cameras that moved between episodes, from the static background of their images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.dataset.finding import Finding, Unknown
from pytest_twin.errors import TwinError
from pytest_twin.formats.recordings.lerobot_video import EpisodeVideo, grey_frames

_WIDTH = 320
"""Pixels of the width to which images are reduced; shifts are in these pixels."""
_EPISODES, _IMAGES = 20, 5
"""Largest number of episodes, evenly chosen, and images of each."""
_STATIC = 8.0
"""Largest difference of grey levels (0 to 255) between the images of a static pixel."""
_LEAST_STATIC = 0.4
"""Fraction of static pixels below which the camera itself moves, as on a wrist."""
_TILES = (3, 4)
"""Rows and columns of tiles that are compared."""
_TEXTURE = 3.0
"""Smallest standard deviation of grey levels in a tile that shows a shift."""
_ABOVE_CHANCE = 1.5
"""Smallest peak of a phase correlation, relative to the highest one of two unrelated images."""
_MOVED, _STILL = 1.5, 1.0
"""Pixels of a shift above which a tile moved and below which it did not."""
_SHARE, _FEWEST_TILES = 0.6, 3
"""Fraction and number of tiles that have to agree."""


@dataclass(frozen=True, slots=True)
class _Background:
    """Median of an episode's images, and the static pixels."""

    grey: FloatArray
    is_static: NDArray[np.bool_]


def check_cameras(
    videos: Mapping[str, Sequence[EpisodeVideo]],
) -> tuple[dict[str, Any], list[Finding], list[Unknown]]:
    """Return the verdict on each camera, with findings and what is unknown.

    Args:
        videos: camera -> video of each episode, in order.
    """
    verdicts: dict[str, Any] = {}
    findings: list[Finding] = []
    unknown: list[Unknown] = []
    for camera, episodes in videos.items():
        verdict = _check(camera, episodes)
        if isinstance(verdict, Unknown):
            unknown.append(verdict)
            verdicts[camera] = {"verdict": "unknown", "why": verdict.why}
            continue
        verdicts[camera] = {"verdict": "moved" if verdict else "still", "why": None}
        findings += verdict
    return verdicts, findings, unknown


def _check(camera: str, episodes: Sequence[EpisodeVideo]) -> list[Finding] | Unknown:
    places = np.unique(np.linspace(0, len(episodes) - 1, _EPISODES).astype(int))
    chosen = [episodes[place] for place in places]
    try:
        backgrounds = [_background(grey_frames(one, _IMAGES, _WIDTH)) for one in chosen]
    except TwinError as error:
        return Unknown(f"whether {camera} moved", str(error), "decode its videos")
    static = float(np.median([one.is_static.mean() for one in backgrounds]))
    if static < _LEAST_STATIC:
        return Unknown(
            f"whether {camera} moved",
            f"only {100 * static:.0f} % of its image is static within an episode: it moves with "
            "the arm, or the whole scene moves",
            "a marker on the part that carries it",
        )
    moves, unmatched = [], []
    for at in range(1, len(backgrounds)):
        shift = _shift(backgrounds[at - 1], backgrounds[at])
        if shift is None:
            unmatched.append(chosen[at].episode)
        elif shift > _MOVED:
            moves.append((chosen[at - 1].episode, chosen[at].episode, shift))
    if unmatched:
        return Unknown(
            f"whether {camera} moved",
            f"the background of episode {unmatched[0]} does not match that before it: light, scene "
            "or view changed",
            "look at the first images of these episodes",
        )
    return [
        Finding(
            "camera_moved",
            f"the background shifts by {100 * shift / _WIDTH:.1f} % of the width of the image "
            f"between episodes {before} and {after}",
            "calibrate the camera again, or separate the episodes before and after",
            camera, (after,),
        )
        for before, after, shift in moves
    ]  # fmt: skip


def _background(images: FloatArray) -> _Background:
    return _Background(np.median(images, axis=0), np.ptp(images, axis=0) <= _STATIC)


def _shift(first: _Background, second: _Background) -> float | None:
    """Median shift of the tiles, px; 0 if most stand still, None if they do not agree."""
    if first.grey.shape != second.grey.shape:
        return None
    height, width = first.grey.shape
    shifts = []
    for row in range(_TILES[0]):
        for column in range(_TILES[1]):
            rows = slice(row * height // _TILES[0], (row + 1) * height // _TILES[0])
            columns = slice(column * width // _TILES[1], (column + 1) * width // _TILES[1])
            static = first.is_static[rows, columns] & second.is_static[rows, columns]
            tiles = (first.grey[rows, columns], second.grey[rows, columns])
            if static.mean() < _LEAST_STATIC or min(float(np.std(t)) for t in tiles) < _TEXTURE:
                continue
            found, peak = _phase_correlation(*tiles)
            if peak >= _ABOVE_CHANCE:
                shifts.append(found)
    if len(shifts) < _FEWEST_TILES:
        return None
    sizes = np.array(shifts)
    if (sizes < _STILL).mean() >= _SHARE:
        return 0.0
    return float(np.median(sizes)) if (sizes > _MOVED).mean() >= _SHARE else None


def _phase_correlation(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    """Size of the shift between two images, px, and height of the peak relative to chance.

    The correlation of unrelated images is noise with the standard deviation 1 / sqrt(frequencies),
    of which the largest of n pixels is about sqrt(2 ln n) standard deviations.
    """
    window = np.outer(*(np.hanning(size) for size in first.shape))
    spectra = [np.fft.rfft2((one - one.mean()) * window) for one in (first, second)]
    cross = spectra[0] * np.conj(spectra[1])
    # Frequencies without power are noise.
    size = np.abs(cross)
    has_power = size > 1e-3 * size.max()
    cross = np.where(has_power, cross / np.maximum(size, 1e-12), 0.0)
    peaks = np.fft.irfft2(cross, s=first.shape) / has_power.mean()
    chance = math.sqrt(2.0 * math.log(peaks.size) / (has_power.mean() * peaks.size))
    at = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
    wrapped = [place if 2 * place <= size else place - size
               for place, size in zip(at, peaks.shape, strict=True)]  # fmt: skip
    return math.hypot(*wrapped), float(peaks[at]) / chance
