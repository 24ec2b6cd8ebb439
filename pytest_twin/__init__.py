"""Test a robot's digital twin, sign what passes, and find missing physics.

For programs, each with an example in its docstring:

    load_model     a model, a ``twin.yaml`` or the folder of a diagnosis
    read_trials    a recording as trials of the model
    replay         predict the motion of trials from their commands
    diagnose       find the physics that a model lacks
    identify       estimate its parameters
    calibrate      estimate joint zeros, geometry, cameras, clocks
    verify         check a signed release

Input that cannot be used raises :class:`TwinError`. Everything else is internal.
"""

import sys
from typing import TYPE_CHECKING, Any

if not sys.flags.safe_path and any(
    option == "-m" and module.partition(".")[0] == "pytest_twin"
    for option, module in zip(sys.orig_argv, sys.orig_argv[1:], strict=False)
):
    # `python -m pytest_twin.cli` puts the working folder first, which holds the files of a robot.
    del sys.path[0]

from pytest_twin.errors import TwinError

if TYPE_CHECKING:
    from pytest_twin.library import (
        LoadedModel,
        calibrate,
        diagnose,
        identify,
        load_model,
        read_trials,
        replay,
        verify,
    )

__all__ = [
    "LoadedModel",
    "TwinError",
    "__version__",
    "calibrate",
    "diagnose",
    "identify",
    "load_model",
    "read_trials",
    "replay",
    "verify",
]


def __getattr__(name: str) -> Any:
    # PEP 562: the simulator is loaded by the first of these, not by `import pytest_twin`.
    if name == "__version__":
        from importlib.metadata import version

        return version("pytest-twin")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pytest_twin import library

    return getattr(library, name)


def __dir__() -> list[str]:
    return __all__
