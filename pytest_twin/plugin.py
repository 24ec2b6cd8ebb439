"""Hooks of the pytest plugin.

pytest loads this module in every run of every project. It imports the rest of pytest-twin only
when a twin is found.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_twin.session.options import Options, add_options, read_options
from pytest_twin.session.release_fixture import TwinRelease, twin_release
from pytest_twin.session.result_folders import is_fitted_model
from pytest_twin.systems import unsupported_system, unusable_mujoco

if TYPE_CHECKING:
    from pytest_twin.session.session import TwinSession

__all__ = ["TwinRelease", "twin_release"]

_TWIN_FILE = "twin.yaml"
_GOLDEN_FOLDER = "golden"
_SOURCE_FOLDER = "source"
_OWN_OUTPUT = ("releases", "keys", ".twin")
_OPTIONS: pytest.StashKey[Options] = pytest.StashKey()
_FOLDERS: pytest.StashKey[dict[Path, Path | None]] = pytest.StashKey()
_REFUSAL: pytest.StashKey[str | None] = pytest.StashKey()
_SESSION: pytest.StashKey[TwinSession] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the command line options."""
    add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    """Read the command line options; refuse those that contradict one another."""
    config.stash[_OPTIONS] = read_options(config)
    if config.getoption("markers", False):
        _session(config)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Find the twins before collection where an option needs one; else collection finds them."""
    config = session.config
    options = config.stash[_OPTIONS]
    if options.needs_twin and not hasattr(config, "workerinput"):
        if (problem := _refusal(config)) is not None:
            raise pytest.UsageError(problem)
        _discover(config)
        if _SESSION not in config.stash:
            raise pytest.UsageError(
                f"no {_TWIN_FILE} at, above or below {', '.join(map(str, config.args))}: "
                "pytest-twin init ROBOT makes one"
            )
        if options.update:
            _session(config).add_audits()


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Skip the folders that pytest-twin writes: a release contains copies of specs.

    A supplier's files are skipped too: tests in them are not the twin's, and would run as code.
    """
    if collection_path.name in _OWN_OUTPUT and (collection_path.parent / _TWIN_FILE).is_file():
        return True
    if collection_path.name == _SOURCE_FOLDER:
        from pytest_twin.asset.manifest import is_source_folder

        return is_source_folder(collection_path) or None
    return None


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect a YAML file below a twin's folder ``golden`` as a golden spec."""
    if file_path.suffix != ".yaml":
        return None
    if file_path.name == _TWIN_FILE:
        if is_fitted_model(file_path):
            return None
        if _refusal(parent.config) is not None:
            return RefusedTwin.from_parent(parent, path=file_path)
        _session(parent.config).gate(file_path)
        return None
    if _GOLDEN_FOLDER not in file_path.parts:
        return None
    twin_file = _twin_file(file_path.parent, parent.config.stash.setdefault(_FOLDERS, {}))
    if twin_file is None:
        return None
    if _refusal(parent.config) is not None:
        return RefusedTwin.from_parent(parent, path=file_path)
    return _session(parent.config).spec(file_path, twin_file, parent)


class RefusedTwin(pytest.File):
    """A twin's file on a machine that cannot run goldens with the given options."""

    def collect(self) -> list[pytest.Item]:
        """Collect nothing.

        Raises:
            CollectError: always, with the reason in one line.
        """
        raise self.CollectError(_refusal(self.config))


def _twin_file(folder: Path, known: dict[Path, Path | None]) -> Path | None:
    """The nearest ``twin.yaml`` in a folder or its parents, or None; ``known`` is a cache."""
    if folder not in known:
        candidate = folder / _TWIN_FILE
        if candidate.is_file():
            known[folder] = candidate
        else:
            known[folder] = None if folder.parent == folder else _twin_file(folder.parent, known)
    return known[folder]


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Send the plan to a pytest-xdist worker: only the controller decides what is stale."""
    config: pytest.Config = node.config
    if _SESSION not in config.stash and _refusal(config) is None:
        _discover(config)
    if _SESSION in config.stash:
        node.workerinput["twin"] = config.stash[_SESSION].for_workers()


def _refusal(config: pytest.Config) -> str | None:
    """Why this machine cannot run goldens with the given options; None where it can."""
    if _REFUSAL not in config.stash:
        from pytest_twin.realization.import_path import installed_modules_only

        # A file of the robot may be called `mujoco.py`.
        with installed_modules_only((config.rootpath,)):
            problem = unsupported_system() or unusable_mujoco()
        if problem is None and config.stash[_OPTIONS].confine:
            from pytest_twin.realization.confinement import why_not_confined

            found = why_not_confined()
            problem = None if found is None else f"--twin-confine: {found}"
        config.stash[_REFUSAL] = problem
    return config.stash[_REFUSAL]


def _session(config: pytest.Config) -> TwinSession:
    if _SESSION not in config.stash:
        from pytest_twin.realization.import_path import installed_modules_only

        with installed_modules_only((config.rootpath,)):
            from pytest_twin.session.session import TwinSession

        config.stash[_SESSION] = session = TwinSession(config, config.stash[_OPTIONS])
        config.pluginmanager.register(session, "twin-session")
    return config.stash[_SESSION]


def _discover(config: pytest.Config) -> None:
    from pytest_twin.realization.import_path import installed_modules_only

    with installed_modules_only((config.rootpath,)):
        from pytest_twin.session.discovery import twin_files

    arguments = [Path(str(argument).split("::")[0]) for argument in config.args]
    include_above = config.stash[_OPTIONS].needs_twin
    for path in twin_files(arguments, config, include_above=include_above):
        _session(config).gate(path)
