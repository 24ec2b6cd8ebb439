"""Compare bytecode caches with the source beside them: Python may run one in place of the other."""

from __future__ import annotations

import ast
import importlib.util
import marshal
import re
import sys
from pathlib import Path
from types import CodeType

from pytest_twin.errors import TwinError
from pytest_twin.formats.paths import read_bytes

_MAX_BYTES = 64 * 2**20
"""Largest size of a source file or a cache."""
_HEADER_BYTES = 16
"""Magic number, flags, and time and size, or the hash, of the source (PEP 552)."""
_HASH_BASED, _CHECK_SOURCE = 0b01, 0b10
_OF_A_PYTHON = re.compile(r"(cpython|pypy|graalpy)-?\d")


def caches_of(source: Path) -> list[Path]:
    """Caches of a module's source that this Python, or pytest in it, may run."""
    folder = source.parent / "__pycache__"
    return sorted(folder.glob(f"{source.stem}.{sys.implementation.cache_tag}*.pyc"))


def is_of_its_source(cache: Path) -> bool:
    """Whether a file in ``__pycache__`` changes nothing: Python would make the same of the source.

    This is also so if the cache is of another version of Python, or of an earlier source: neither
    is run.
    """
    tag = cache.name.partition(".")[2].removesuffix(".pyc")
    if cache.suffix != ".pyc" or not _OF_A_PYTHON.match(tag):
        return False
    if not tag.startswith(sys.implementation.cache_tag):
        return True
    source = cache.parent.parent / f"{cache.name.partition('.')[0]}.py"
    try:
        text, compiled = read_bytes(source, _MAX_BYTES), read_bytes(cache, _MAX_BYTES)
        if not _is_run(compiled, source, text):
            return True
        # Python has read this file in the same way, if it has run it.
        code = marshal.loads(compiled[_HEADER_BYTES:])
        return bool(code in _compiled(text, source, tag))
    except (TwinError, OSError, ValueError, EOFError, TypeError, SyntaxError):
        return False


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


def _compiled(text: bytes, source: Path, tag: str) -> list[CodeType]:
    """The code of a source, as Python or pytest's assertion rewriting compiles it."""
    if "-pytest-" not in tag:
        level = tag.rpartition(".opt-")[2] if ".opt-" in tag else "0"
        return [compile(text, str(source), "exec", dont_inherit=True, optimize=int(level))]
    # pytest has no public name for this. Without it such a cache counts as another code.
    from _pytest.assertion.rewrite import rewrite_asserts

    tree = ast.parse(text, filename=str(source))
    rewrite_asserts(tree, text, str(source), None)
    return [compile(tree, str(source), "exec", dont_inherit=True)]
