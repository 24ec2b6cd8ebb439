"""A short run of the reading benchmark."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "read_recording.py"


def test_both_readers_give_the_same_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    spec = importlib.util.spec_from_file_location("read_recording_benchmark", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.main(["--seconds", "0.5", "--repeat", "1"]) == 0
    printed = capsys.readouterr().out
    assert "1000 messages" in printed
    assert "the same" in printed
