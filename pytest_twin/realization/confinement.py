"""Restrict a child process to the files that it needs, with Landlock (Linux 5.13 and later).

Run as a script, this module gives up access to all other files and then executes a command. The
kernel enforces the restriction for the command, its threads and its child processes:

- Files of the twin's roots, of Python and of the system's libraries can be read.
- Only a temporary folder, and folders that are given for it, can be written.
- No TCP connection (Linux 6.7), no signal to another process, no abstract socket (Linux 6.12).

Landlock has no rules for UDP and named Unix sockets, which stay accessible.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

_SYSTEM = (
    *("/usr", "/bin", "/sbin", "/lib", "/lib64", "/nix/store"),
    *("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/localtime", "/etc/passwd", "/etc/group"),
    *("/etc/nsswitch.conf", "/etc/fonts", "/etc/alternatives"),
    # Landlock itself denies access to the environment and memory of other processes.
    *("/proc", "/sys/devices/system", "/dev/zero", "/dev/random", "/dev/urandom"),
)
_VARIABLES = ("PATH", "LANG", "LANGUAGE", "TZ", "LD_LIBRARY_PATH", "VIRTUAL_ENV")
_VARIABLE_PREFIXES = ("LC_", "PYTHON", "OMP_", "OPENBLAS_", "MKL_", "MUJOCO_")
# First ABI versions of Landlock with network rules and with scopes, and the bits of both.
_ABI_NETWORK, _ABI_SCOPES = 4, 6
_BIND_AND_CONNECT_TCP = 0b11
"""Landlock's bits for TCP: bind and connect."""
_SIGNALS_AND_SOCKETS = 0b11
"""Landlock's bits of scopes: abstract Unix sockets and signals."""


def why_not_confined() -> str | None:
    """Why this machine cannot restrict a process, and what to do; None where it can."""
    if sys.platform != "linux":
        return "confinement needs Linux; run without it, or in a container"
    try:
        import landlock
    except ImportError:
        return "confinement needs the package landlock: pip install 'pytest-twin[confine]'"
    try:
        landlock.landlock_abi_version()
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        return (
            f"this kernel offers no Landlock ({reason}): confinement needs Linux 5.13 or later "
            "with landlock among its security modules (boot option lsm=landlock,...)"
        )
    return None


def confined_command(
    command: Iterable[str],
    imports: Iterable[str],
    read: Iterable[Path],
    scratch: Path,
    write: Iterable[Path] = (),
) -> list[str]:
    """Command that runs ``command`` with restricted access.

    Args:
        command: path of a program, and its arguments.
        imports: its import path, which it may read.
        read: folders and files that it may read in addition to those of Python and the system.
        scratch: folder that it may write.
        write: further folders that it may write.
    """
    home = Path.home().resolve()
    # An import path that names the home folder must not open all of it.
    imported = [entry for entry in imports if not home.is_relative_to(Path(entry).resolve())]
    readable = [*_SYSTEM, sys.prefix, sys.base_prefix, *imported, *map(str, read)]
    # -P: a module in the working directory does not replace an installed one.
    start = [sys.executable, "-P", "-m", __name__, str(scratch), *map(str, write)]
    return [*start, "--", *dict.fromkeys(readable), "--", *command]


def confined_environment(environment: Mapping[str, str], scratch: Path) -> dict[str, str]:
    """Environment variables that a program needs, without secrets; ``scratch`` is its home."""
    kept = {
        name: value
        for name, value in environment.items()
        if name in _VARIABLES or name.startswith(_VARIABLE_PREFIXES)
    }
    place = str(scratch)
    return kept | {"HOME": place, "TMPDIR": place, "MPLCONFIGDIR": place}


def confine(read: Iterable[str], write: Iterable[str]) -> None:
    """Restrict this process and its children as the docstring of this module states.

    Args:
        read: folders and files that stay readable; those that do not exist are ignored.
        write: folders that stay writable.

    Raises:
        OSError: the kernel refuses the rules.
    """
    import landlock
    from landlock import plumbing

    class NoNetwork(plumbing.RulesetAttr):  # type: ignore[misc]
        """Newer fields of the ruleset, which the library lacks."""

        _fields_ = (("handled_access_net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))

    rights = landlock.FSAccess
    rules = landlock.Ruleset()
    for path in map(Path, read):
        if path.is_dir():
            rules.allow(path, rules=rights.READ_FILE | rights.READ_DIR | rights.EXECUTE)
        elif path.exists():
            rules.allow(path, rules=rights.READ_FILE | rights.EXECUTE)
    rules.allow(os.devnull, rules=rights.READ_FILE | rights.WRITE_FILE)
    for folder in write:
        rules.allow(folder)
    rules.apply()
    abi = plumbing.landlock_abi_version()
    if abi >= _ABI_NETWORK:
        scoped = abi >= _ABI_SCOPES
        attributes = NoNetwork(0, _BIND_AND_CONNECT_TCP, _SIGNALS_AND_SOCKETS if scoped else 0)
        size = ctypes.sizeof(attributes) - (0 if scoped else ctypes.sizeof(ctypes.c_uint64))
        ruleset = plumbing.get_create_ruleset()(ctypes.byref(attributes), size, 0)
        plumbing.get_restrict_self()(ruleset, 0)


def main(arguments: list[str]) -> None:
    """Restrict this process, and replace it by the command after the second ``--``.

    Args:
        arguments: folders that may be written, ``--``, paths that may be read, ``--``, command.
    """
    first = arguments.index("--")
    second = arguments.index("--", first + 1)
    command = arguments[second + 1 :]
    confine(arguments[first + 1 : second], arguments[:first])
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
