"""Run a command that can read only its case folder and the files of its programs.

    python benchmarks/concealed/confine.py --read CASE --write FOLDER -- COMMAND ...

The kernel enforces this for the command and all its children (Landlock, Linux 5.13 and later). If
the package lies outside the environment, only the names in its parent folder can be listed.
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
    """Whether this system can restrict the file access of a command."""
    if landlock is None:
        return False
    try:
        return bool(landlock.landlock_abi_version() > 0)
    except OSError:
        return False


def confine(read: Path, write: Path) -> None:
    """Restrict this process and its children to these folders and the files of the programs.

    Args:
        read: folder that may be read.
        write: folder that may be read and written.

    Raises:
        ModuleNotFoundError: pytest_twin is not installed.
        OSError: the kernel does not support it.
    """
    # The package is located but not imported.
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
    """Restrict this process and execute the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--read", type=Path, required=True)
    parser.add_argument("--write", type=Path, required=True)
    parser.add_argument("command", nargs="+")
    args = parser.parse_args()
    confine(args.read, args.write)
    os.execv(args.command[0], args.command)


if __name__ == "__main__":
    main()
