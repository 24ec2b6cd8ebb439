"""For the project's own tests; the plugin itself comes by its entry point."""

import gc
import os
import sys

import pytest

pytest_plugins = ["pytester"]

# Hundreds of tests start a pytest or a command of their own. Where the environment forbids to keep
# compiled modules, as images of containers do, each of them compiles the package again: 2 to 3 s.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# No test draws with OpenGL; without this, each child that imports MuJoCo loads a window library:
# 0.1 s.
os.environ.setdefault("MUJOCO_GL", "off")


def pytest_configure(config: pytest.Config) -> None:
    """Workers of xdist share the cores out: forks of one would be in the way of the other."""
    worker = getattr(config, "workerinput", None)
    if worker is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        number = int(worker["workerid"].removeprefix("gw"))
        os.sched_setaffinity(0, cores[number :: worker["workercount"]] or cores)
    if worker is not None or not config.getoption("numprocesses", None):
        # What a test starts gets no option of this run. It does not load the plugin of Hypothesis,
        # whose summary imports all of Hypothesis: 0.4 s.
        os.environ["PYTEST_ADDOPTS"] = "-p no:hypothesispytest"


def pytest_collection_finish() -> None:
    """Thousands of collected tests stay: without this, each collection of garbage visits them.

    A fifth of the time of tests that make many objects.
    """
    gc.collect()
    gc.freeze()
