"""pytest-twin: test a robot's digital twin, sign what passes, and find missing physics."""

import sys

if not sys.flags.safe_path and any(
    option == "-m" and module.partition(".")[0] == "pytest_twin"
    for option, module in zip(sys.orig_argv, sys.orig_argv[1:], strict=False)
):
    # `python -m pytest_twin.cli` puts the working folder first, which holds the files of a robot.
    del sys.path[0]

from pytest_twin.errors import TwinError

__all__ = ["TwinError", "__version__"]
__version__ = "0.1.0"
