"""Functions that the sandbox tests call in the child process."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def echo(value: Any) -> Any:
    return value


def variable(name: str) -> str | None:
    return os.environ.get(name)


def process() -> int:
    return os.getpid()


def count(steps: int, progress: Callable[[float], None]) -> str:
    for step in range(steps):
        print("step", step)
        progress((step + 1) / steps)
    return "done"


def spin() -> None:
    while True:
        time.sleep(0.01)


def spin_in_forks() -> None:
    from pytest_twin.realization.forks import in_forks

    in_forks([spin, spin], 2)


def compile_without_end(path: str) -> int:
    from pytest_twin.realization import load

    return int(load(Path(path)).model.nv)


def crash(name: str) -> None:
    print("about to crash", flush=True)
    os.kill(os.getpid(), getattr(signal, name))


def swallow(size: int) -> int:
    return len(bytearray(size))


def swallow_in_mujoco(size: int) -> int:
    import mujoco

    return int(mujoco.MjModel.from_xml_string(f"<mujoco><size memory='{size}'/></mujoco>").narena)


def leave(status: int) -> None:
    os._exit(status)


def raise_value_error() -> None:
    raise ValueError("a user's own mistake\nin two lines")


def raise_model_error() -> None:
    from pytest_twin.errors import ModelError

    raise ModelError(
        "bad", path="/a/b.xml", line=3, column=2, where="x", value=1.5, unit="kg", expected="more"
    )


def give_an_object() -> object:
    return object()


def simulators() -> list[str]:
    return [name for name in ("mujoco", "pinocchio") if name in sys.modules]


def load_model(path: str) -> list[str]:
    from pytest_twin.realization import load

    return list(load(Path(path)).joints)


def load_text(text: str, folder: str, suffix: str) -> tuple[str, str | None] | None:
    """None, or message and file of a typed error; any other exception is a defect and is raised."""
    from pytest_twin.errors import TwinError
    from pytest_twin.realization import load

    path = Path(folder) / f"model{suffix}"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        realization = load(path, accept_invalid_inertia=True)
        realization.reference.mass()
    except TwinError as error:
        return str(error), None if error.path is None else str(error.path)
    return None


def files_of_modules(names: list[str]) -> dict[str, str | None]:
    return {name: importlib.import_module(name).__file__ for name in names}
