"""pytest-twin: keep a robot's digital twin trustworthy, one signed release at a time."""

from pytest_twin.errors import TwinError

__all__ = ["TwinError", "__version__"]
__version__ = "0.1.0"
