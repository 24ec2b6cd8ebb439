"""Figures of a calibration: corners in images, residuals, solvers, covariance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.report.figures import png, svg
from pytest_twin.report.plot_style import DIM, FAIL, GOLDEN, INK, NOW, PASS
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ARROW_SHARE = 0.03
"""Length of the 95 % quantile of arrows, as a share of the image's width."""
_ARROW_REACH = 0.12
"""Length of the 95 % quantile of error arrows in space, as a share of the scene's extent."""
_LONGEST_BAR = 2.5
"""Largest ratio of a bar to the median, so that a failed solver does not hide the others."""
_ELLIPSE = 2.4477
"""Radius of a 95 % ellipse in standard deviations (chi-square with two degrees of freedom)."""


def solvers_figure(document: Mapping[str, Any]) -> bytes:
    """Draw the held-out translation error of each solver, as SVG."""
    errors = {
        name: 1e3 * one["translation_rms"]
        for name, one in document["solvers"].items()
        if "translation_rms" in one
    }
    names = sorted(errors, key=lambda name: -errors[name])
    longest = _LONGEST_BAR * float(np.median(list(errors.values()))) if errors else 1.0

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.2, 0.2, 0.7, 0.76))
        colours = [NOW if name == "least_squares" else DIM for name in names]
        lengths = [min(errors[name], longest) for name in names]
        axes.barh(range(len(names)), lengths, color=colours, height=0.65)
        axes.set_yticks(range(len(names)), [printable(name.replace("_", " ")) for name in names])
        for at, (name, length) in enumerate(zip(names, lengths, strict=True)):
            cut = " (bar cut)" if errors[name] > length else ""
            axes.text(length, at, f" {errors[name]:.2f}{cut}", va="center", color=INK)
        axes.margins(x=0.16)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("held-out translation error, root mean square [mm]")

    return svg(draw, 7.0, 0.9 + 0.27 * max(len(names), 1))


def speeds_figure(document: Mapping[str, Any]) -> bytes:
    """Draw the angular speeds of two streams on one clock, as SVG."""
    speeds = document["angular_speeds"]

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.09, 0.2, 0.89, 0.7))
        axes.plot(speeds["time"], speeds["camera"], color=DIM, linewidth=1.0, label="camera")
        axes.plot(speeds["time"], speeds["hand"], color=NOW, linewidth=1.0, label="hand")
        axes.set_xlim(speeds["time"][0], speeds["time"][-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("time from the beginning of the hand's stream [s]")
        axes.set_ylabel("angular speed [rad/s]")
        axes.legend(loc="upper right")

    return svg(draw, 7.6, 2.8)


def residuals_figure(document: Mapping[str, Any]) -> bytes:
    """Draw magnified reprojection residuals of all images over the image plane, as SVG."""
    images = list(document["images"].values())
    places = np.concatenate([np.array(one["pixels"]) for one in images])
    residuals = np.concatenate([np.array(one["residuals"]) for one in images])
    width, height = images[0]["size"]
    usual = max(float(np.percentile(np.linalg.norm(residuals, axis=1), 95.0)), 1e-9)
    scale = _ARROW_SHARE * width / usual

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.09, 0.11, 0.89, 0.8))
        axes.quiver(
            *places.T, *residuals.T, angles="xy", scale_units="xy", scale=1.0 / scale,
            width=0.0022, color=NOW,
        )  # fmt: skip
        axes.set_xlim(0, width)
        axes.set_ylim(height, 0)
        axes.set_aspect("equal")
        axes.set_title(f"arrows {scale:.0f} times magnified; 95 % are shorter than {usual:.2f} px")
        axes.set_xlabel("x [px]")
        axes.set_ylabel("y [px]")

    return svg(draw, 7.0, 1.0 + 6.2 * height / width)


def scene_figure(document: Mapping[str, Any]) -> bytes:
    """Draw the chain at one pose, its frames, and errors over the workspace, as SVG."""
    scene = document["scene"]
    arrows = scene["arrows"]
    places = np.array([one["at"] for one in arrows]).reshape(-1, 3)
    errors = np.array([one["error"] for one in arrows]).reshape(-1, 3)
    frames = np.array([one["xyz"] for one in scene["frames"]])
    everything = np.vstack([places, frames, *(np.array([one["xyz"]]) for one in scene["chain"])])
    reach = float(np.ptp(everything, axis=0).max())
    usual = max(float(np.percentile(np.linalg.norm(errors, axis=1), 95.0)), 1e-9) if arrows else 1.0
    scale = _ARROW_REACH * reach / usual

    def draw(figure: Figure) -> None:
        axes: Any = figure.add_axes((0.0, 0.02, 1.0, 0.92), projection="3d")
        _connections(axes, scene)
        for number, one in enumerate(scene["frames"]):
            # The labels of the flange and of its payload are close: put one above, one below.
            _axes_of_frame(axes, one, 0.07 * reach, 0.6 if number == 1 else -0.5)
        for kind, colour in (("fitted", DIM), ("held_out", NOW)):
            chosen = np.array([one["kind"] == kind for one in arrows], dtype=bool)
            if not chosen.any():
                continue
            axes.scatter(*places[chosen].T, s=3, color=colour, depthshade=False)
            axes.quiver(
                *places[chosen].T, *(scale * errors[chosen]).T, color=colour, linewidth=1.0,
                arrow_length_ratio=0.25, label=kind.replace("_", "-"),
            )  # fmt: skip
        centre, half = (everything.max(axis=0) + everything.min(axis=0)) / 2.0, 0.52 * reach
        for name, middle in zip("xyz", centre, strict=True):
            getattr(axes, f"set_{name}lim")(middle - half, middle + half)
            getattr(axes, f"set_{name}label")(f"{name} [m]")
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=22, azim=-55)
        if arrows:
            axes.legend(loc="upper right")
        figure.text(
            0.02, 0.96,
            f"arrows {scale:.0f} times magnified; 95 % are shorter than {1e3 * usual:.2f} mm",
            color=INK,
        )  # fmt: skip

    return svg(draw, 7.6, 6.4)


def _connections(axes: Any, scene: Mapping[str, Any]) -> None:
    """Draw the arm from base to flange, and dashed lines to attached frames."""
    base, flange, *others = (np.array(one["xyz"]) for one in scene["frames"])
    if scene["chain"]:
        chain = np.array([one["xyz"] for one in scene["chain"]])
        axes.plot(*chain.T, "o-", color=GOLDEN, linewidth=2.2, markersize=4, zorder=1)
    else:
        axes.plot(*np.stack([base, flange]).T, "--", color=GOLDEN, linewidth=1.6, zorder=1)
    for frame, place in zip(scene["frames"][2:], others, strict=True):
        start = flange if frame["on_flange"] else base
        axes.plot(*np.stack([start, place]).T, "--", color=DIM, linewidth=0.9, zorder=1)


def _axes_of_frame(axes: Any, frame: Mapping[str, Any], length: float, place: float) -> None:
    at = np.array(frame["xyz"])
    for axis, colour in zip(frame["axes"], (FAIL, PASS, NOW), strict=True):
        end = at + length * np.array(axis)
        axes.plot(*np.stack([at, end]).T, color=colour, linewidth=1.6)
    axes.text(*(at + place * length), printable(frame["name"]), color=INK, fontsize=8.5, zorder=9)


def covariance_figure(record: Mapping[str, Any], name: str) -> bytes:
    """Draw 95 % confidence ellipses of a transform's position and orientation, as SVG."""
    covariance = np.array(record["covariance"])

    def draw(figure: Figure) -> None:
        pairs = ((0, 1), (0, 2), (1, 2))
        for row, (start, factor, unit) in enumerate(((0, 1e3, "mm"), (3, 1e3, "mrad"))):
            labels = ("x", "y", "z") if row == 0 else ("rx", "ry", "rz")
            block = factor**2 * covariance[start : start + 3, start : start + 3]
            reach = 1.15 * _ELLIPSE * float(np.sqrt(np.diag(block).max()))
            for column, (a, b) in enumerate(pairs):
                axes = figure.add_axes((0.1 + 0.31 * column, 0.58 - 0.48 * row, 0.22, 0.34))
                axes.plot(*_ellipse(block[np.ix_((a, b), (a, b))]), color=NOW)
                axes.plot([0], [0], "+", color=INK)
                axes.set_xlim(-reach, reach)
                axes.set_ylim(-reach, reach)
                axes.set_box_aspect(1)
                axes.set_xlabel(f"{labels[a]} [{unit}]")
                axes.set_ylabel(f"{labels[b]} [{unit}]")
                if row == column == 0:
                    axes.set_title(printable(f"{name.replace('_', ' ')}: 95 % ellipses"))

    return svg(draw, 7.6, 5.4)


def overlay_figure(image: NDArray[np.uint8], one: Mapping[str, Any], title: str) -> bytes:
    """Draw the image near the target, with detected corners and reprojections, as PNG."""
    pixels, residuals = np.array(one["pixels"]), np.array(one["residuals"])
    room = 0.15 * float(np.ptp(pixels, axis=0).max())
    low = np.maximum(pixels.min(axis=0) - room, 0).astype(int)
    high = (pixels.max(axis=0) + room).astype(int) + 1

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.0, 0.0, 1.0, 0.93))
        part = image[low[1] : high[1], low[0] : high[0]]
        extent = (low[0] - 0.5, low[0] + part.shape[1] - 0.5,
                  low[1] + part.shape[0] - 0.5, low[1] - 0.5)  # fmt: skip
        axes.imshow(part, cmap="gray", extent=extent, vmin=0, vmax=255)
        axes.plot(*pixels.T, "o", markersize=7, markerfacecolor="none", color=PASS)
        axes.plot(*(pixels + residuals).T, "+", markersize=6, color=FAIL)
        axes.set_axis_off()
        axes.set_title(printable(title), fontsize=8.5)

    shape = high - low
    return png(draw, 4.6, 0.3 + 4.6 * float(shape[1]) / float(shape[0]))


def _ellipse(block: FloatArray) -> FloatArray:
    """Return (2, n) points of the 95 % ellipse of a (2, 2) covariance."""
    angle = np.linspace(0.0, 2.0 * np.pi, 120)
    values, axes = np.linalg.eigh(block)
    radii = _ELLIPSE * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(axes @ (radii[:, None] * np.array([np.cos(angle), np.sin(angle)])))
