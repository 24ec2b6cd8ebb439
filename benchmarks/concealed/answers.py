"""Pack diagnoses of blind cases into one file, and unpack them.

    python benchmarks/concealed/answers.py pack --results DIR --file FILE
    python benchmarks/concealed/answers.py unpack --results DIR --file FILE

The file has a line of JSON for every case: the record of ``run.py`` and the diagnosis. The unpacked
folder can be read by ``score.py`` and ``usual_way.py`` and continued by ``run.py``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path


def pack(results: Path, file: Path) -> int:
    """Write one line for every case that was run; return their number."""
    lines = []
    for path in sorted(results.glob("*.run.json")):
        run = json.loads(path.read_text())
        diagnosis = results / run["case"] / "diagnosis.json"
        said = json.loads(diagnosis.read_text()) if diagnosis.exists() else None
        lines.append(json.dumps({"run": run, "said": said}, separators=(",", ":")))
    file.write_text("".join(f"{line}\n" for line in lines))
    return len(lines)


def unpack(file: Path, results: Path) -> int:
    """Write the results of every case without results; return their number.

    Raises:
        ValueError: the name of a case leads out of the folder.
    """
    written = 0
    for line in file.read_text().splitlines():
        answer = json.loads(line)
        case = answer["run"]["case"]
        if not case.isidentifier():
            raise ValueError(f"{file}: case {case!r}, expected a name like case58000")
        run = results / f"{case}.run.json"
        if run.exists():
            continue
        (results / case).mkdir(parents=True, exist_ok=True)
        if answer["said"] is not None:
            said = json.dumps(answer["said"], indent=1)
            (results / case / "diagnosis.json").write_text(said + "\n")
        run.write_text(json.dumps(answer["run"], indent=1) + "\n")
        written += 1
    return written


def main() -> None:
    """Pack or unpack."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("way", choices=("pack", "unpack"))
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--file", type=Path, required=True)
    args = parser.parse_args()
    packs = args.way == "pack"
    count = pack(args.results, args.file) if packs else unpack(args.file, args.results)
    print(f"{args.way}ed {count} cases")


if __name__ == "__main__":
    main()
