"""Time of reading a recording into arrays, relative to decoding by ``mcap-ros2-support``.

    python benchmarks/read_recording.py                 ten minutes, seven joints, 1 kHz
    python benchmarks/read_recording.py --seconds 5     a short sample

Both readers alternate in one process. The baseline only decodes. The equality of the values is
checked afterwards, outside of the measured time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pytest_twin.formats.mcap import JointSeries, Recording, read_recording, write_recording

GOAL = 10.0


def generate(path: Path, seconds: float, rate: float = 1000.0, joints: int = 7) -> None:
    """Write states and position commands at ``rate`` Hz: sines with sensor noise."""
    random = np.random.default_rng(7)
    count = round(seconds * rate)
    names = tuple(f"joint{index + 1}" for index in range(joints))
    time_s = np.arange(count) / rate
    phase = 2.0 * np.pi * 0.2 * time_s[:, None] + np.arange(joints)
    stamp = 1_700_000_000_000_000_000 + np.arange(count) * round(1e9 / rate)

    def noisy(values: np.ndarray) -> np.ndarray:
        return values + random.normal(0.0, 1e-3, values.shape)

    state = JointSeries(
        topic="/joint_states",
        names=names,
        stamp=stamp,
        log_time=stamp + 120_000,
        position=noisy(np.sin(phase)),
        velocity=noisy(0.4 * np.pi * np.cos(phase)),
        effort=noisy(-3.0 * np.sin(phase)),
    )
    command = JointSeries(
        topic="/joint_commands",
        names=names,
        stamp=stamp,
        log_time=stamp,
        position=np.sin(phase + 0.02),
        velocity=None,
        effort=None,
    )
    write_recording(path, [state, command], {"role": "fit"})


def decode_with_ros2_support(path: Path) -> int:
    """The baseline: decode every message, keep none."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def differences(path: Path, recording: Recording) -> list[str]:
    """Return differences between the two readers; empty if all values are equal."""
    by_topic = {series.topic: series for series in recording.series.values()}
    rows = dict.fromkeys(by_topic, 0)
    found = []
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            series = by_topic[channel.topic]
            row = rows[channel.topic]
            rows[channel.topic] += 1
            stamp = decoded.header.stamp.sec * 1_000_000_000 + decoded.header.stamp.nanosec
            same = row < len(series.stamp) and series.stamp[row] == stamp
            same = same and series.log_time[row] == message.log_time
            for name in ("position", "velocity", "effort"):
                ours, theirs = getattr(series, name), list(getattr(decoded, name))
                same = same and (ours[row].tolist() if ours is not None else []) == theirs
            if not same:
                found.append(f"{channel.topic} message {row}")
    found += [t for t, s in by_topic.items() if rows[t] != len(s.stamp)]
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the recording")
    parser.add_argument("--repeat", type=int, default=2, help="turns of each reader")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.mcap"
        generate(path, options.seconds)
        ours: list[float] = []
        theirs: list[float] = []
        for _ in range(options.repeat):
            start = time.perf_counter()
            recording = read_recording(path)
            ours.append(time.perf_counter() - start)
            start = time.perf_counter()
            messages = decode_with_ros2_support(path)
            theirs.append(time.perf_counter() - start)
        found = differences(path, recording)
        size = path.stat().st_size
    print(f"recording     {options.seconds:g} s, {messages} messages, {size / 1e6:.1f} MB")
    print(f"pytest-twin   {min(ours):.3f} s")
    print(f"ros2-support  {min(theirs):.3f} s")
    print(f"ratio         {min(theirs) / min(ours):.1f} (goal: at least {GOAL:g})")
    print(f"numbers       {'the same' if not found else f'differ: {found[:5]}'}")
    return 1 if found or recording.damage else 0


if __name__ == "__main__":
    sys.exit(main())
