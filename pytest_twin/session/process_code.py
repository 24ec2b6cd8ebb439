"""Find the code and settings of this process: ``conftest.py``, modules, configuration, plugins."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Collection, Iterator
from importlib import metadata
from importlib.machinery import PathFinder, all_suffixes
from pathlib import Path
from types import ModuleType

import pytest

from pytest_twin.dependency import Part
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.gate.distributions import code_sha256
from pytest_twin.gate.process import PLUGIN_LAYER, GateProcess, file_part
from pytest_twin.realization.import_path import import_path, is_installed
from pytest_twin.session.bytecode import caches_of, is_of_its_source

_PLUGINS = "pytest11"
"""Group of the entry points through which pytest finds installed plugins."""
_PACKAGE = Path(__file__).parents[1]
_OWN_DISTRIBUTION = "pytest-twin"
_PYTEST_AND_OWN = frozenset({"pytest", "_pytest", "pluggy", "pytest_twin"})
# pytest puts the parent of a package of tests on the import path; `test` is a usual name of one,
# and only tests import the module of Python's library with this name.
_FREE_NAMES = frozenset({"test"})


def process_code(config: pytest.Config, root: Path, tests: Collection[Path]) -> GateProcess:
    """Code and settings that this process has loaded, as far as they are not part of pytest.

    Args:
        root: the twin's folder.
    """
    loaded = set(_local_modules(config, root))
    loaded.update(path for path in _plugin_modules(config) if not is_installed(path))
    if config.inipath is not None:
        loaded.add(config.inipath)
    files, parts, problems = {}, _plugin_parts(config), []
    for path in sorted(loaded):
        if path.is_relative_to(_PACKAGE):
            continue
        problems += [
            f"{cache}: is not the bytecode of {path.name}, and Python runs it (expected: delete it)"
            for cache in caches_of(path)
            if not is_of_its_source(cache, config)
        ]
        try:
            files[path] = file_sha256(path)
            if path not in tests:
                part = file_part(root, path)
                parts[part.id] = part
        except TwinError as error:
            problems.append(str(error))
    problems += _hiding_modules(config, root)
    return GateProcess(parts, files, tuple(problems))


def _folders(config: pytest.Config, root: Path) -> tuple[Path, ...]:
    """Folders with files of the user: of the twin, of pytest's root and of the invocation."""
    return (root, config.rootpath, config.invocation_params.dir)


def _local_modules(config: pytest.Config, root: Path) -> Iterator[Path]:
    """Files of loaded modules in the twin's folder, pytest's root and the working folder."""
    folders = tuple(
        {
            f"{spell(folder)}{os.sep}"
            for folder in _folders(config, root)
            for spell in (os.path.abspath, os.path.realpath)
        }
    )
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and file.startswith(folders) and not is_installed(Path(file)):
            yield Path(file)


def _plugin_modules(config: pytest.Config) -> Iterator[Path]:
    """Files of all plugins that are modules: ``conftest.py``, and those of the option ``-p``."""
    for plugin in config.pluginmanager.get_plugins():
        file = getattr(plugin, "__file__", None)
        if isinstance(plugin, ModuleType) and isinstance(file, str):
            yield Path(file)


@functools.cache
def _entry_points() -> dict[str, tuple[metadata.Distribution, tuple[str, ...]]]:
    """Name of each distribution with plugins of pytest -> the distribution, its plugin modules."""
    found: dict[str, tuple[metadata.Distribution, tuple[str, ...]]] = {}
    for point in metadata.entry_points(group=_PLUGINS):
        if point.dist is not None and point.dist.name != _OWN_DISTRIBUTION:
            modules = found.get(point.dist.name, (point.dist, ()))[1]
            found[point.dist.name] = (point.dist, (*modules, point.module))
    return found


@functools.cache
def _plugin_part(name: str) -> Part:
    distribution, modules = _entry_points().get(name) or (metadata.distribution(name), ())
    return Part(
        f"{PLUGIN_LAYER}{name}",
        {"version": distribution.version, "sha256": code_sha256(distribution, modules)},
    )


def _plugin_parts(config: pytest.Config) -> dict[str, Part]:
    """Parts of the distributions with plugins, those that an option switches off included.

    Options such as ``-p no:NAME`` must not make goldens stale.
    """
    names = dict.fromkeys(_entry_points())
    with_entry_point = {
        module.partition(".")[0] for _, modules in _entry_points().values() for module in modules
    }
    tops = {
        plugin.__name__.partition(".")[0]
        for plugin in config.pluginmanager.get_plugins()
        if isinstance(plugin, ModuleType)
        and plugin.__file__
        and is_installed(Path(plugin.__file__))
    }
    # Modules that the option -p names, in packages that declare no plugin.
    if others := tops - with_entry_point - _PYTEST_AND_OWN:
        packages = metadata.packages_distributions()
        names.update(dict.fromkeys(name for top in others for name in packages.get(top, ())))
    return {part.id: part for part in map(_plugin_part, sorted(names))}


def _hiding_modules(config: pytest.Config, root: Path) -> Iterator[str]:
    """Lines about local modules that hide a module of Python, of pytest or of pytest-twin.

    Such a module can change every verdict, and after its import it can remove all traces.
    """
    children = import_path((root, config.rootpath))
    library = next((sys.path.index(e) for e in sys.path if e == str(Path(os.__file__).parent)), 0)
    for entry in dict.fromkeys(sys.path[:library]):
        if entry in children:
            continue
        for name, path in _modules_in(Path(entry)):
            if (
                name not in _FREE_NAMES
                and _is_of_the_gate(name, children)
                and not _is_copy_of_installed(name, path, children, config)
            ):
                yield (
                    f"{path}: hides the installed module {name!r} in this process (expected "
                    f"{_way_out(Path(entry), config)})"
                )


def _way_out(folder: Path, config: pytest.Config) -> str:
    """What to do about a module in ``folder`` that hides an installed one."""
    way = "another name"
    if any((folder / name).is_file() for name in ("pyproject.toml", "setup.py")):
        way = f"the files of the installed one: pip install {folder}"
    if folder == config.invocation_params.dir and not (folder / "conftest.py").is_file():
        # A conftest.py also puts its folder on the import path.
        way += ", or `pytest` instead of `python -m pytest`"
    return way


def _is_copy_of_installed(
    name: str, path: Path, children: list[str], config: pytest.Config
) -> bool:
    """Whether each file of the module at ``path`` is a copy of one of the installed module.

    This is so in a checkout of pytest-twin itself. Compiled modules count, because Python may run
    them in place of their source; caches in which Python keeps the same code as in the source do
    not.
    """
    spec = PathFinder.find_spec(name, children)
    if spec is None or spec.origin is None:
        return False
    if path.is_file():
        return _same_content(path, Path(spec.origin))
    installed = Path(spec.origin).parent
    return all(
        _same_content(file, installed / file.relative_to(path))
        or (file.parent.name == "__pycache__" and is_of_its_source(file, config))
        for file in path.rglob("*")
        if not file.is_dir()
    )


def _same_content(file: Path, other: Path) -> bool:
    try:
        return file.name == other.name and file_sha256(file) == file_sha256(other)
    except TwinError:
        return False


def _modules_in(folder: Path) -> Iterator[tuple[str, Path]]:
    suffixes = tuple(all_suffixes())
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.name.endswith(suffixes) and path.is_file():
            yield path.name.partition(".")[0], path
        elif path.is_dir() and any((path / f"__init__{suffix}").is_file() for suffix in suffixes):
            yield path.name, path


def _is_of_the_gate(name: str, children: list[str]) -> bool:
    if name in sys.stdlib_module_names or name in _PYTEST_AND_OWN:
        return True
    spec = PathFinder.find_spec(name, children)
    return spec is not None and spec.origin is not None and name in _modules_of_the_gate()


@functools.cache
def _modules_of_the_gate() -> frozenset[str]:
    """Top-level modules of the distributions that pytest and pytest-twin require."""
    required: set[str] = set()
    waiting = ["pytest", _OWN_DISTRIBUTION]
    while waiting:
        name = _normalized(waiting.pop())
        if name in required:
            continue
        required.add(name)
        try:
            lines = metadata.requires(name) or ()
        except metadata.PackageNotFoundError:
            continue
        waiting += [re.split(r"[^\w.-]", line)[0] for line in lines if "extra ==" not in line]
    packages = metadata.packages_distributions().items()
    return frozenset(m for m, names in packages if required & {_normalized(n) for n in names})


def _normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
