"""Run a command that can read its case and the programs it is made of, and no other file.

    python benchmarks/concealed/confine.py --read CASE --write FOLDER -- COMMAND ...

The kernel holds the command and all its children to that (Landlock, Linux 5.13 and later). Where
the package lies outside the environment, the names beside it can be listed, and no more.
"""

from __future__ import annotations

import argparse
import os
import sys
from importlib.util import find_spec
from pathlib import Path

try:
    import landlock
except ImportError:  # not on Linux
    landlock = None

_SYSTEM = ("/usr", "/bin", "/lib", "/lib64", "/etc", "/proc", "/sys", "/dev")


def confinable() -> bool:
    """Whether this system can hold a command to what it is given."""
    if landlock is None:
        return False
    try:
        return bool(landlock.landlock_abi_version() > 0)
    except OSError:
        return False


def confine(read: Path, write: Path) -> None:
    """Give up, for this process and its children, every file but these and the programs'.

    Args:
        read: a folder that may be read.
        write: a folder that may be read and written.

    Raises:
        ModuleNotFoundError: the package that diagnoses is not installed.
        OSError: the kernel refuses.
    """
    # Found, not imported: nothing beside the plant runs the package's code.
    spec = find_spec("pytest_twin")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("pytest_twin is not installed beside this Python")
    package = Path(spec.origin).parent
    libraries = {path for path in sys.path if Path(path).name == "site-packages"}
    programs = {*_SYSTEM, sys.prefix, sys.base_prefix, str(package), *libraries}
    rights = landlock.FSAccess
    readable = rights.READ_FILE | rights.READ_DIR
    rules = landlock.Ruleset()
    rules.allow(*filter(os.path.exists, programs), rules=readable | rights.EXECUTE)
    # Python lists a folder of sys.path before it finds a package in it.
    rules.allow(str(package.parent), rules=rights.READ_DIR)
    rules.allow("/dev/null", rules=rights.READ_FILE | rights.WRITE_FILE)
    rules.allow(str(read), rules=readable)
    rules.allow(str(write))
    rules.apply()


def main() -> None:
    """Confine this process and become the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--read", type=Path, required=True)
    parser.add_argument("--write", type=Path, required=True)
    parser.add_argument("command", nargs="+")
    args = parser.parse_args()
    confine(args.read, args.write)
    os.execv(args.command[0], args.command)


if __name__ == "__main__":
    main()
