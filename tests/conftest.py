"""Fixtures that every area shares."""

pytest_plugins = ["pytester"]
