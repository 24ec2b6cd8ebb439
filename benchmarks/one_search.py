"""`pytest-twin diagnose` with the search that is to replace the present ones, in this process.

    python benchmarks/one_search.py diagnose MODEL RECORDING ... --out DIR [--seconds N]

``main`` is an entry of ``yardstick.py --entry``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pytest_twin.commands import diagnose as command
from pytest_twin.commands.recording_arguments import recording_options
from pytest_twin.diagnosis.one_search.structure import find_structure
from pytest_twin.formats import results
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE
from pytest_twin.loaded_model import find_model


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose as the command does; return 0 if no residual is unexplained, else 1."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(description=__doc__)
    command.add_arguments(parser)
    args = parser.parse_args(given[1:])
    out: Path = args.out.absolute()
    seconds = command.SECONDS if args.seconds is None else args.seconds
    with results.result_folder(out, DIAGNOSIS_FILE, alone=True) as staging:
        summary = command.diagnose_files(
            {
                "model": str(find_model(args.model)),
                "recordings": [str(r.absolute()) for r in args.recordings],
                "held_out": [str(r.absolute()) for r in args.held_out],
                "out": str(staging),
                "folder": str(out),
                "topics": args.topics,
                "options": recording_options(args),
                "seconds": seconds,
            },
            find=find_structure,
        )
    print("\n".join(summary["words"]))
    return 0 if summary["verdict"] in ("no_mismatch", "explained") else 1


if __name__ == "__main__":
    sys.exit(main())
