"""Find the options and arguments of a command line that select a subset of the tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest


def selected_by(config: pytest.Config) -> tuple[str, ...]:
    """Options that select a subset of the tests, as written on the command line."""
    return tuple(_options(config))


def _options(config: pytest.Config) -> Iterator[str]:
    for flag, name in (("-k", "keyword"), ("-m", "markexpr")):
        value = config.getoption(name, "")
        if value:
            yield f"{flag} {value!r}"
    for flag, name in (
        ("--deselect", "deselect"),
        ("--ignore", "ignore"),
        ("--ignore-glob", "ignore_glob"),
    ):
        for value in config.getoption(name, None) or ():
            yield f"{flag} {value}"
    if config.getoption("lf", False):
        yield "--lf"
    if config.getoption("stepwise", False):
        yield "--stepwise"
    for argument in config.args:
        if "::" in str(argument):
            yield str(argument)


def partial_arguments(config: pytest.Config, root: Path) -> tuple[str, ...]:
    """Arguments that select only a part of a twin's folder; empty if one contains its root."""
    paths = [config.invocation_params.dir / str(a).split("::")[0] for a in config.args]
    absolute = [Path(path).absolute() for path in paths]
    if any(root.is_relative_to(path) for path in absolute):
        return ()
    return tuple(str(a) for a in config.args)
