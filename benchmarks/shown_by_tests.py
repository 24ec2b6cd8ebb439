"""Tests that depend on the thresholds of a diagnosis.

    python benchmarks/shown_by_tests.py --out DIR tests/diagnosis ...

A threshold that changes no small diagnosis (``sensitivity.py``) may still have its reason: a test
shows the case that it is for. This runs tests once and follows half and twice of every number in a
settings object through their computations (``variants.py``). A test depends on a number if some
comparison has another outcome with half or twice of it. What a test does in a child process is not
followed.

Appends to DIR/CODE/tests.jsonl, from which ``sensitivity.py`` takes the column ``tests``. A test
that is there already is not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sensitivity import FACTORS, Field, code_digest, followed, settings_fields


class Following:
    """A plugin of pytest that follows the fields through each test, with its fixtures."""

    def __init__(self, fields: list[Field], path: Path) -> None:
        self.fields, self.path = fields, path
        self.known = set()
        if path.exists():
            self.known = {json.loads(line)["test"] for line in path.read_text().splitlines()}
        self.failed = False

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid not in self.known]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed = self.failed or report.failed

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.failed = False
        with followed(self.fields) as (read, altering):
            result = yield
        # A test that fails because it is followed may depend on all that it reads.
        every = {(name, factor) for name in read for factor in FACTORS}
        changes = sorted(every if self.failed else altering)
        entry = {"test": item.nodeid, "altering": changes}
        with self.path.open("a") as stream:
            stream.write(json.dumps(entry) + "\n")
        return result


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("tests", metavar="TEST", nargs="+", help="file, folder or id of a test")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    args = parser.parse_args()
    out = args.out / code_digest()
    out.mkdir(parents=True, exist_ok=True)
    following = Following(settings_fields(), out / "tests.jsonl")
    # The package is imported before pytest can rewrite its assertions.
    options = ["-q", "-p", "no:cacheprovider", "--tb=no", "-W"]
    options.append("ignore::pytest.PytestAssertRewriteWarning")
    pytest.main([*options, *args.tests], plugins=[following])
    return 0


if __name__ == "__main__":
    sys.exit(main())
