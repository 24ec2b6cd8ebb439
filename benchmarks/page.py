"""Write the page of benchmarks from their records.

    python benchmarks/page.py [--results benchmarks/results] [--page docs/benchmarks.md]

Every figure of the page is in a record of ``benchmarks/record.py``. Benchmarks without a record are
listed too.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE / "results"
PAGE = HERE.parent / "docs" / "benchmarks.md"
HEAD = """# Benchmarks

<!-- not run on this page: benchmarks take minutes to hours -->

<!-- Written by benchmarks/page.py. Change the records or the script, not this page. -->

Each section shows the output of one benchmark with its date, git revision (`+`: with changes), and
machine. `load` is the average number of waiting processes before and after the run: wall times of a
loaded machine are too long. To measure again and to write this page:

```sh
python benchmarks/record.py NAME [ARGUMENT ...]
python benchmarks/page.py
```

Pages about one subject have further figures, each next to its command:
[how often a diagnosis is right](explanation/how_often_right.md),
[real machines](explanation/real_machines.md),
[robots of suppliers](assets-table.md), [thresholds](sensitivity.md).
"""


def scripts() -> dict[str, str]:
    """Return name of each benchmark with a command line -> first line of its docstring."""
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        name = path.relative_to(HERE).with_suffix("").as_posix()
        tree = ast.parse(path.read_text("utf-8"))
        text = ast.get_docstring(tree) or ""
        if f"python benchmarks/{name}.py" in text and name not in ("record", "page"):
            found[name] = text.split("\n")[0]
    return found


def section(one: dict[str, Any], what: str) -> str:
    """Return the section of one record."""
    here = one["machine"]
    packages = ", ".join(f"{name} {number}" for name, number in here["packages"].items())
    failed = f", **exit status {one['exit_status']}**" if one["exit_status"] else ""
    machine = f"{here['processor']}, {here['cores']} cores, {here['system']}"
    times = f"wall time {one['wall_seconds']:g} s, processor time {one['processor_seconds']:g} s"
    load = f"load {one['load_before']:g} before and {one['load_after']:g} after"
    return f"""## {one["benchmark"]}

{what}

- command: `{one["command"]}`
- date {one["date"]}, revision `{one["revision"]}`{failed}
- {machine}, Python {here["python"]}, {packages}
- {times}, {load}

```text
{one["output"].rstrip()}
```
"""


def page(results: Path) -> str:
    """Return the page with all records of a folder."""
    known = scripts()
    records = [json.loads(path.read_text("utf-8")) for path in sorted(results.glob("*.json"))]
    have = {one["benchmark"] for one in records}
    rest = [f"- `benchmarks/{name}.py`: {what}" for name, what in known.items() if name not in have]
    missing = "\n".join(["## Without a record", "", *rest, ""]) if rest else ""
    sections = [section(one, known.get(one["benchmark"], "")) for one in records]
    return "\n".join([HEAD, *sections, missing]).rstrip() + "\n"


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the records")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to write")
    args = parser.parse_args()
    args.page.write_text(page(args.results), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
