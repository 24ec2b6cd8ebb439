"""Suppress MuJoCo's warnings on the terminal and its log file in the working directory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import mujoco


@contextlib.contextmanager
def suppress_mujoco_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warnings within a block; warning counters and errors report the same."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
