"""What is said where the libraries of USD are not there: it depends on the Python."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pytest_twin.realization import usd


@pytest.mark.parametrize("version", [(3, 13), (3, 14)])
def test_a_python_without_a_release_is_named_and_no_install_is_advised(
    monkeypatch: pytest.MonkeyPatch, version: tuple[int, int]
) -> None:
    monkeypatch.setattr(sys, "version_info", (*version, 0, "final", 0))
    words = str(usd.missing("USD cannot be read", path=Path("a.usdc")))
    assert words == (
        "a.usdc: USD cannot be read: its libraries (usd-exchange) have no release for Python "
        f"{version[0]}.{version[1]} (expected Python 3.11 or 3.12, with "
        "pip install 'pytest-twin[usd]')"
    )


def test_an_older_python_is_told_to_install_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 12, 0, "final", 0))
    assert str(usd.missing("USD is left out")) == (
        "USD is left out: the extra 'usd' is not installed "
        "(expected pip install 'pytest-twin[usd]')"
    )
