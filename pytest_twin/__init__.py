"""pytest-twin: test a robot's digital twin, sign what passes, and find missing physics."""

from pytest_twin.errors import TwinError

__all__ = ["TwinError", "__version__"]
__version__ = "0.1.0"
