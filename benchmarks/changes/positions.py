"""Changes of real servos from positions alone: XL330 at other gains, and where nothing changed.

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/positions.py --out DIR gains|unchanged [NAME]

`gains`: 12 ordered pairs of the firmware gains 100, 200, 400 and 800, four recordings each, without
the metadata that state the gain. `unchanged`: disjoint groups of recordings of one robot with one
gain, of which the last is compared with the others; XL330 in 4 groups of 4, SO-101 in 6 of 5. Names
are those of cases, such as `100-400` or `so101_2`; all by default. A case whose folder is in DIR is
not run again. Each runs with the default limit of time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from injected import interval
from mcap.reader import make_reader
from mcap.writer import Writer

sys.path.append(str(Path(__file__).resolve().parents[1] / "real"))
from recorded import folder_of

GAINS = (100, 200, 400, 800)
SO101_GROUPS, SO101_SIZE = 6, 5
SURE = 0.9

Case = tuple[Path, list[Path], list[Path]]
"""Model, earlier recordings and new ones."""


def without_controller(source: Path, target: Path) -> Path:
    """Copy a recording without the metadata that state its controller."""
    with source.open("rb") as read, target.open("wb") as written:
        reader, writer = make_reader(read), Writer(written)
        summary = reader.get_summary()
        assert summary is not None
        writer.start(profile="ros2")
        schemas = {
            i: writer.register_schema(s.name, s.encoding, s.data)
            for i, s in summary.schemas.items()
        }
        channels = {
            i: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id])
            for i, c in summary.channels.items()
        }
        for record in reader.iter_metadata():
            kept = {k: v for k, v in record.metadata.items() if k != "controller"}
            writer.add_metadata(record.name, kept)
        for _, channel, message in reader.iter_messages():
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def gain_cases(scratch: Path) -> Iterator[tuple[str, Case]]:
    """Every ordered pair of gains."""
    folder = folder_of("xl330")
    logs: dict[int, list[Path]] = {gain: [] for gain in GAINS}
    for path in sorted((folder / "recordings").glob("*.mcap")):
        copy = without_controller(path, scratch / path.name)
        logs[int(path.name.split("_")[0].removeprefix("kp"))].append(copy)
    for old, new in itertools.permutations(GAINS, 2):
        yield f"{old}-{new}", (folder / "model.xml", logs[old], logs[new])


def unchanged_cases() -> Iterator[tuple[str, Case]]:
    """Disjoint groups of recordings of one robot."""
    folder = folder_of("xl330")
    for gain in GAINS:
        logs = sorted((folder / "recordings").glob(f"kp{gain}_*.mcap"))
        yield f"xl330_{gain}", (folder / "twin.yaml", logs[:-1], logs[-1:])
    folder = folder_of("so101")
    logs = sorted((folder / "recordings").glob("*.mcap"))
    for k in range(SO101_GROUPS):
        group = logs[k * SO101_SIZE : (k + 1) * SO101_SIZE]
        yield f"so101_{k}", (folder / "model.xml", group[:-1], group[-1:])


def compare(case: Case, out: Path) -> dict[str, Any]:
    """Run the command, unless its result is there."""
    model, before, new = case
    result = out / "diagnosis.json"
    if not result.is_file():
        subprocess.run(
            [sys.executable, "-m", "pytest_twin.cli", "diagnose", str(model), *map(str, new),
             "--before", *map(str, before), "--out", str(out)],
            check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
    return dict(json.loads(result.read_text())) if result.is_file() else {}


def is_right_gain(name: str, document: dict[str, Any]) -> tuple[bool, str]:
    """Whether the gain is named first with its ratio, and nothing else is sure; and the answer."""
    findings = document["findings"]
    sure = [f for f in findings if f["confidence"] >= SURE]
    if not findings:
        return False, document["verdict"]
    first = findings[0]
    text = f"{first['effect']} {first['confidence']:.2f}"
    if first["effect"] != "controller_gain":
        return False, text
    old, new = map(int, name.split("-"))
    before = 1.0 + first["known_before"]["stiffness_error"]["value"]
    low, high = ((before + x) / before for x in first["change"]["stiffness_error"]["ci95"])
    value = 1.0 + first["change"]["stiffness_error"]["value"] / before
    others = [f for f in sure if f["effect"] != "controller_gain"]
    text += f", ratio {value:.2f} ({low:.2f} to {high:.2f}), true {new / old:g}"
    return low <= new / old <= high and not others, text


def main(argv: Sequence[str] | None = None) -> None:
    """Run cases and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("kind", choices=("gains", "unchanged"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(argv)
    scratch = args.out / "recordings"
    scratch.mkdir(parents=True, exist_ok=True)
    cases = dict(gain_cases(scratch) if args.kind == "gains" else unchanged_cases())
    right = done = 0
    for name in args.names or cases:
        document = compare(cases[name], args.out / name)
        if not document:
            print(f"{name}: refused")
            continue
        if args.kind == "gains":
            is_right, text = is_right_gain(name, document)
        else:
            alarm = document["alarm"]
            is_right = document["verdict"] != "no_change"
            text = f"score {alarm['score']:.3g}, alarm above {alarm['threshold']:.3g}"
        right, done = right + is_right, done + 1
        print(f"{name}: {'yes' if is_right else 'no'}, {text}", flush=True)
    if done:
        print(f"{right} of {done} ({interval(right, done)})")


if __name__ == "__main__":
    main()
