"""Import the modules that a task golden declares, and no other module of its folder.

The digests of declared files are part of the golden's dependencies. A module that is not declared
could change the result of the golden without making it stale.
"""

from __future__ import annotations

import contextlib
import importlib.machinery
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from pytest_twin.checks.fields import spec_error
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden

_FIELD = "target.files"
_NO_BYTECODE = "__no_bytecode__"
"""Folder for bytecode that does not exist, so that no cached bytecode is found."""


@contextlib.contextmanager
def declared_modules(
    golden: Golden, function_file: Path, files: Mapping[Path, str]
) -> Iterator[None]:
    """Make the declared modules beside a function importable, and forget them afterwards.

    The child process runs several goldens, whose modules may have equal names. Cached bytecode is
    neither read nor written: it counts as current if time and size of the source are equal, so that
    a source changed within the same second could run in its old form.

    Args:
        golden: the golden, for errors.
        files: other files that the golden declares -> the path as written.

    Raises:
        SpecError: a declared module has the name of an installed one.
    """
    finder = _DeclaredModules(golden, function_file, files)
    before = set(sys.modules)
    bytecode = sys.pycache_prefix, sys.dont_write_bytecode
    sys.meta_path.insert(0, finder)
    sys.pycache_prefix = str(function_file.parent / _NO_BYTECODE)
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.pycache_prefix, sys.dont_write_bytecode = bytecode
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            if name in finder.names or name in finder.packages:
                del sys.modules[name]


def load_file(path: Path) -> ModuleType:
    """Load a file as a separate module.

    Raises:
        SpecError: not a Python file, or not valid Python.
    """
    spec = importlib.util.spec_from_file_location(f"pytest_twin_task_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise SpecError("cannot be loaded", path=path, expected="a Python file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickling look a module up by its name.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise SpecError(f"not valid Python: {error.msg}", path=path, line=error.lineno) from error
    return module


class _DeclaredModules:
    """Finder of the modules that a golden declares, relative to the folder of its function.

    Attributes:
        names: full module name -> file.
        packages: full names of the packages that contain declared modules.
    """

    def __init__(self, golden: Golden, function_file: Path, files: Mapping[Path, str]) -> None:
        self._golden, self._folder = golden, function_file.parent
        self.names: dict[str, Path] = {}
        for path, written in files.items():
            if path.suffix != ".py" or not path.is_relative_to(self._folder):
                continue
            name = _module_name(path.relative_to(self._folder))
            if self._is_installed(name):
                raise spec_error(
                    golden,
                    _FIELD,
                    "a module with the name of an installed one",
                    value=written,
                    expected="another name, which no module of Python or of a package has",
                )
            self.names[name] = path
        # The file itself has another module name; its neighbours may import it by its own.
        if not self._is_installed(function_file.stem):
            self.names.setdefault(function_file.stem, function_file)
        self.packages = {
            ".".join(parts[:count])
            for parts in (name.split(".") for name in self.names)
            for count in range(1, len(parts))
        }

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module that the golden declares; None if the function's folder has no such name.

        Raises:
            SpecError: the folder has such a module, and the golden does not declare it.
        """
        if name in self.names:
            file = self.names[name]
            # Without search locations: other modules of the package must be declared too.
            inside: list[str] | None = [] if file.name == "__init__.py" else None
            return importlib.util.spec_from_file_location(
                name, file, submodule_search_locations=inside
            )
        if name.partition(".")[0] not in self.packages and self._is_installed(name):
            return None
        if undeclared := self._undeclared(name):
            raise spec_error(
                self._golden,
                _FIELD,
                f"the function imports {name!r}, a module that the golden does not declare",
                value=str(undeclared),
                expected="every module of the twin that the function imports",
            )
        if name in self.packages:
            return ModuleSpec(name, None, is_package=True)
        return None

    def _is_installed(self, name: str) -> bool:
        """Whether the top-level module of ``name`` is importable without the function's folder."""
        top = name.partition(".")[0]
        if top in sys.stdlib_module_names:
            return True
        spec = PathFinder.find_spec(top)
        # The twin may itself be an editable installation.
        return (
            spec is not None
            and spec.origin is not None
            and not Path(spec.origin).is_relative_to(self._folder)
        )

    def _undeclared(self, name: str) -> Path | None:
        module_path = self._folder.joinpath(*name.split("."))
        suffixes = importlib.machinery.all_suffixes()
        candidates = [module_path / f"__init__{suffix}" for suffix in suffixes]
        candidates += [module_path.with_name(f"{module_path.name}{suffix}") for suffix in suffixes]
        return next((path for path in candidates if path.is_file()), None)


def _module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)
