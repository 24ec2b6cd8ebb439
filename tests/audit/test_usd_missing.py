"""Error message without the USD libraries, for supported and unsupported Python versions."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pytest_twin.realization import usd


@pytest.mark.parametrize("version", [(3, 13), (3, 14)])
def test_on_an_unsupported_python_the_message_names_supported_versions(
    monkeypatch: pytest.MonkeyPatch, version: tuple[int, int]
) -> None:
    monkeypatch.setattr(sys, "version_info", (*version, 0, "final", 0))
    words = str(usd.missing("USD cannot be read", path=Path("a.usdc")))
    assert words == (
        "a.usdc: USD cannot be read: its libraries (usd-exchange) have no release for Python "
        f"{version[0]}.{version[1]} (expected Python 3.11 or 3.12, with "
        "pip install 'pytest-twin[usd]')"
    )


def test_on_a_supported_python_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 12, 0, "final", 0))
    assert str(usd.missing("USD is left out")) == (
        "USD is left out: the extra 'usd' is not installed "
        "(expected pip install 'pytest-twin[usd]')"
    )
