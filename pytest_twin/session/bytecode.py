"""Compare bytecode caches with the source beside them: Python may run one in place of the other."""

from __future__ import annotations

import ast
import importlib.util
import marshal
import re
import sys
from pathlib import Path
from types import CodeType

import pytest

from pytest_twin.errors import TwinError
from pytest_twin.formats.paths import read_bytes

_MAX_BYTES = 64 * 2**20
"""Largest size of a source file or a cache."""
_HEADER_BYTES = 16
"""Magic number, flags, and time and size, or the hash, of the source (PEP 552)."""
_HASH_BASED, _CHECK_SOURCE = 0b01, 0b10
_SUFFIXES = (".pyc", ".pyo")
_OF_PYTEST = "-pytest-"
_PYTEST_TAG = f"{sys.implementation.cache_tag}{_OF_PYTEST}{pytest.__version__}"
_OF_A_PYTHON = re.compile(r"(cpython|pypy|graalpy)-?\d")


def caches_of(source: Path) -> list[Path]:
    """Caches of a module's source that this Python, or its pytest, may run."""
    folder = source.parent / "__pycache__"
    return sorted(folder.glob(f"{source.stem}.{sys.implementation.cache_tag}*.py[co]"))


def is_of_its_source(cache: Path, config: pytest.Config) -> bool:
    """Whether a file in ``__pycache__`` changes nothing: the source would give the same code.

    This is also so if the cache is of another version of Python or of pytest, or of an earlier
    source: none of these is run.

    Args:
        config: settings of this run, on which pytest's rewriting of assertions depends.
    """
    tag = cache.name.partition(".")[2].removesuffix(cache.suffix)
    if cache.suffix not in _SUFFIXES or not _OF_A_PYTHON.match(tag):
        return False
    is_of_pytest = _OF_PYTEST in tag
    if not tag.startswith(sys.implementation.cache_tag) or (is_of_pytest and tag != _PYTEST_TAG):
        return True
    source = cache.parent.parent / f"{cache.name.partition('.')[0]}.py"
    try:
        text, compiled = read_bytes(source, _MAX_BYTES), read_bytes(cache, _MAX_BYTES)
        if not _is_run(compiled, source, text):
            return True
        # Python has read this file in the same way, if it has run it.
        code = marshal.loads(compiled[_HEADER_BYTES:])
        if is_of_pytest:
            return bool(code == _rewritten(text, source, config))
        level = int(tag.rpartition(".opt-")[2]) if ".opt-" in tag else 0
        plain = compile(text, str(source), "exec", dont_inherit=True, optimize=level)
        return bool(code == plain)
    except (TwinError, OSError, ValueError, EOFError, TypeError, SyntaxError, ImportError):
        return False


def _rewritten(text: bytes, source: Path, config: pytest.Config) -> CodeType:
    """The code that pytest makes of a source, whose assertions it rewrites.

    No public function of pytest returns it.

    Raises:
        ImportError: this version of pytest rewrites elsewhere.
    """
    from _pytest.assertion.rewrite import rewrite_asserts

    tree = ast.parse(text, filename=str(source))
    rewrite_asserts(tree, text, str(source), config)
    code: CodeType = compile(tree, str(source), "exec", dont_inherit=True)
    return code


def _is_run(compiled: bytes, source: Path, text: bytes) -> bool:
    """Whether Python runs a cache, by its header."""
    if compiled[:4] != importlib.util.MAGIC_NUMBER:
        return False
    flags = int.from_bytes(compiled[4:8], "little")
    if flags & _HASH_BASED:
        stated = compiled[8:_HEADER_BYTES]
        return not flags & _CHECK_SOURCE or stated == importlib.util.source_hash(text)
    stat = source.stat()
    words = (int(stat.st_mtime) & 0xFFFFFFFF, stat.st_size & 0xFFFFFFFF)
    return compiled[8:_HEADER_BYTES] == b"".join(word.to_bytes(4, "little") for word in words)
