"""Command line options of the plugin; each is also an entry of pytest's configuration file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pytest

SWITCHES = {
    "twin-release": "run the stale goldens, and sign a release unless a critical one fails",
    "twin-update": "record goldens again, with provenance; show old and new values",
    "twin-all": "run all goldens, including those that are unchanged since the last release",
    "twin-diagnose": "diagnose failing goldens of kind replay, and write the patched model",
    "twin-confine": "run goldens without access to other files and the network (Linux, Landlock)",
    "twin-why": "list why each golden is fresh or stale, without running it",
}
VALUES = {
    "twin-report": ("PATH", "file of the HTML report (default: <twin>/.twin/report.html)"),
    "twin-key": ("PATH", "private key that signs the release"),
    "twin-timeout": ("SECONDS", "time limit of one golden in s (default: 600)"),
}
DEFAULT_SECONDS = 600.0
"""Default time limit of one golden."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run, from the command line or the configuration file.

    Attributes:
        release: whether to sign a release.
        update: whether to record goldens.
        everything: whether to run fresh goldens too.
        why: whether to list only why goldens are fresh or stale.
        diagnose: whether to diagnose failures against recordings.
        report: path of the report, None for the default.
        key, ini_key: path of the signing key, from the command line and the configuration file.
        seconds: limit of the wall time of one golden, s.
        confine: whether goldens run without access to other files and to the network.
    """

    release: bool
    update: bool
    everything: bool
    why: bool
    diagnose: bool
    report: Path | None
    key: str | None
    ini_key: str | None
    seconds: float
    confine: bool

    @property
    def needs_twin(self) -> bool:
        """Whether the options make sense only with a twin."""
        return self.release or self.update or self.why


def add_options(parser: pytest.Parser) -> None:
    """Add the command line options and the entries of the configuration file."""
    group = parser.getgroup("twin", "robot twins (pytest-twin)")
    for name, text in SWITCHES.items():
        group.addoption(f"--{name}", action="store_true", default=None, help=text)
        parser.addini(_key(name), text, type="bool", default=False)
    for name, (metavar, text) in VALUES.items():
        group.addoption(f"--{name}", metavar=metavar, default=None, help=text)
        parser.addini(_key(name), text, default=None)


def read_options(config: pytest.Config) -> Options:
    """Read the options of this run.

    Raises:
        pytest.UsageError: they contradict one another or are not valid.
    """
    switches = {name: bool(_value(config, name)) for name in SWITCHES}
    if switches["twin-release"] and switches["twin-update"]:
        raise pytest.UsageError(
            "--twin-release and --twin-update exclude each other: "
            "record first, check the differences, then release"
        )
    if switches["twin-update"] and in_ci():
        raise pytest.UsageError(
            "--twin-update refuses to run in CI (the environment variable CI is set): "
            "a person decides what a golden records"
        )
    report = _value(config, "twin-report")
    key = config.getoption(_key("twin-key"))
    return Options(
        release=switches["twin-release"],
        update=switches["twin-update"],
        everything=switches["twin-all"],
        why=switches["twin-why"],
        diagnose=switches["twin-diagnose"],
        report=None if report is None else config.invocation_params.dir / str(report),
        key=None if key is None else str(config.invocation_params.dir / str(key)),
        ini_key=_ini_path(config, "twin-key"),
        seconds=_seconds(_value(config, "twin-timeout")),
        confine=switches["twin-confine"],
    )


def in_ci() -> bool:
    """Whether the environment variable ``CI`` is set."""
    return os.environ.get("CI", "").strip().lower() not in ("", "0", "false", "no")


def _key(name: str) -> str:
    return name.replace("-", "_")


def _value(config: pytest.Config, name: str) -> object:
    given = config.getoption(_key(name))
    return config.getini(_key(name)) or None if given is None else given


def _ini_path(config: pytest.Config, name: str) -> str | None:
    value = config.getini(_key(name))
    return str(config.rootpath / str(value)) if value else None


def _seconds(value: object) -> float:
    if value is None:
        return DEFAULT_SECONDS
    try:
        seconds = float(str(value))
    except ValueError:
        seconds = float("nan")
    if not 0 < seconds < float("inf"):
        raise pytest.UsageError(
            f"--twin-timeout: got {value!r}, expected a number of seconds above 0"
        )
    return seconds
