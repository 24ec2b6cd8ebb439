"""Processor time of this process and its children, which other programs do not lengthen."""

from __future__ import annotations

import os

import psutil

_running: dict[int, psutil.Process] = {}
"""Children that :func:`processor_seconds` counts while they run, by process id."""
_call_began: float | None = None
_at_fork = 0.0
"""Processor time of the parent when it forked this process, s."""


def processor_seconds() -> float:
    """Processor time of this process and its children, ended or watched, s.

    It continues in a fork with the time of its parent.
    """
    used = os.times()
    own = used.user + used.system + used.children_user + used.children_system
    return _at_fork + own + sum(map(_seconds_of, _running.values()))


def begin_call() -> None:
    """Count the time of a call of a child process from now on, its imports included."""
    global _call_began
    _call_began = processor_seconds()


def call_began() -> float:
    """Processor time at which the present call began in a child process, else the present one."""
    return processor_seconds() if _call_began is None else _call_began


def watch(child: int) -> None:
    """Count the processor time of a child while it runs."""
    _running[child] = psutil.Process(child)


def unwatch(child: int) -> None:
    """Count a child as ended: the system adds its time when this process waits for it."""
    _running.pop(child, None)


def _seconds_of(process: psutil.Process) -> float:
    try:
        used = process.cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(used.user + used.system)


def _continue_in_fork() -> None:
    global _at_fork
    _running.clear()
    _at_fork = _before_fork


def _remember() -> None:
    global _before_fork
    _before_fork = processor_seconds()


_before_fork = 0.0
os.register_at_fork(before=_remember, after_in_child=_continue_in_fork)
