"""For the project's own tests; the plugin itself comes by its entry point."""

import os

import pytest

pytest_plugins = ["pytester"]


def pytest_configure(config: pytest.Config) -> None:
    """Workers of xdist share the cores out: forks of one would be in the way of the other."""
    told = getattr(config, "workerinput", None)
    if told is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        number = int(told["workerid"].removeprefix("gw"))
        os.sched_setaffinity(0, cores[number :: told["workercount"]] or cores)
