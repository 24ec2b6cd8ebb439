"""Draw a reliability diagram of findings (share of right ones by confidence) as SVG or PNG.

python benchmarks/concealed/reliability.py --truth DIR --results DIR --out FILE
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
from family_score import BANDS, calibration, load

Z = 1.96
"""Quantile of the normal distribution for 95 % error bars."""


def wilson(right: int, every: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    p, z2 = right / every, Z * Z / every
    center = (p + z2 / 2) / (1 + z2)
    half = Z * np.sqrt(p * (1 - p) / every + z2 / every / 4) / (1 + z2)
    # With all or none right, rounding must not move the share out of its interval.
    return min(max(center - half, 0.0), p), max(min(center + half, 1.0), p)


def draw(counts: list[tuple[int, int]], out: Path) -> None:
    """Write the diagram of (right, all) in each band."""
    figure, axes = plt.subplots(figsize=(4.5, 4.0))
    axes.plot([0.5, 1.0], [0.5, 1.0], color="0.7", label="calibrated")
    for (low, high), (right, every) in zip(BANDS, counts, strict=True):
        if not every:
            continue
        at, share = (low + high) / 2, right / every
        least, most = wilson(right, every)
        axes.errorbar(at, share, [[share - least], [most - share]], [[at - low], [high - at]],
                      fmt="o", color="C0", capsize=3)  # fmt: skip
        axes.annotate(f"{right}/{every}", (at, share), (4, -12), textcoords="offset points")
    axes.set(xlabel="confidence of a name", ylabel="share of names that are right",
             xlim=(0.48, 1.02), ylim=(-0.02, 1.05))  # fmt: skip
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(out)
    plt.close(figure)


def main() -> None:
    """Draw the diagram."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    draw(calibration(load(args.truth, args.results).values()), args.out)


if __name__ == "__main__":
    main()
