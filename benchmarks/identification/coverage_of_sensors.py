"""Coverage of the 95 % intervals of force-torque sensor parameters, over random sensors.

    python benchmarks/identification/coverage_of_sensors.py --seeds 10:16

The wrench is computed by Pinocchio (``tests/identification/test_sensors.py``). Sensor, motion and
noise are different for each seed. Prints a line for each seed, then the sum.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

TESTS = Path(__file__).parents[2] / "tests"
sys.path += [str(TESTS / "identification"), str(TESTS / "formats")]
import sensor_bags  # noqa: E402
import test_sensors as arm  # noqa: E402

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
NOISE = np.repeat([0.05, 0.003], 3)


def covered(seed: int) -> tuple[int, int, float]:
    """Return number of correct intervals, number of intervals, and filter time constant, s."""
    sensor = arm.random_sensor(seed)

    def readings(true: tuple[np.ndarray, np.ndarray], trial: int) -> np.ndarray:
        clean = sensor.measured(true[0], arm.PERIOD)
        return clean + NOISE * np.random.default_rng([seed, trial]).normal(size=clean.shape)

    with tempfile.TemporaryDirectory() as folder:
        found = arm.identified(Path(folder), sensor_bags.WRENCH, readings, first_motion=100 * seed)
    inside = []
    for row, axis in enumerate(AXES):
        truth = {f"bias_{axis}": sensor.bias[row]}
        for column, source in enumerate(AXES):
            name = f"scale_{axis}" if row == column else f"coupling_{axis}_{source}"
            truth[name] = sensor.coupling[row, column]
        for name, value in truth.items():
            low, high = found["parameters"][f"wrist.sensor_{name}"]["ci95"]
            inside.append(low <= value <= high)
    return sum(inside), len(inside), found["parameters"]["wrist.sensor_filter_time"]["value"]


def main() -> None:
    """Print the coverage of each seed and of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="10:16", help="first:end")
    first, end = map(int, parser.parse_args().seeds.split(":"))
    held = of = 0
    for seed in range(first, end):
        inside, count, constant = covered(seed)
        held, of = held + inside, of + count
        print(f"sensor {seed}: {inside} of {count}, filter {1e3 * constant:.2f} ms", flush=True)
    print(f"all: {held} of {of} ({100 * held / of:.1f} %)")


if __name__ == "__main__":
    main()
