"""For the project's own tests; the plugin itself comes by its entry point."""

import os
import sys

import pytest

pytest_plugins = ["pytester"]

# Hundreds of tests start a pytest or a command of their own. Where the environment forbids to keep
# compiled modules, as images of containers do, each of them compiles the package again: 2 to 3 s.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


def pytest_configure(config: pytest.Config) -> None:
    """Workers of xdist share the cores out: forks of one would be in the way of the other."""
    told = getattr(config, "workerinput", None)
    if told is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        number = int(told["workerid"].removeprefix("gw"))
        os.sched_setaffinity(0, cores[number :: told["workercount"]] or cores)
