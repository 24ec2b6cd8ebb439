"""TIAGo: held-out effort error of torso and arm, and joints without an effort sensor.

    python benchmarks/identification/tiago.py [--out DIR]

Efforts are motor currents with unknown torque constants. The first three quarters of the run are
fitted.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import tiago_files

from pytest_twin import cli


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="keep the files and the identification here")
    args = parser.parse_args()
    source = tiago_files.folder()
    if source is None:
        raise SystemExit("no recordings of TIAGo: the variable TWIN_RECORDINGS says where")
    with tempfile.TemporaryDirectory() as scratch:
        out = args.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        paths = tiago_files.write(source, out)
        return cli.main([
            "identify", str(paths["twin"]), str(paths["fit"]),
            "--held-out", str(paths["held_out"]), "--out", str(out / "identified"),
        ])  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
