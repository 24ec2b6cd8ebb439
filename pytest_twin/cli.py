"""The ``pytest-twin`` command: parse, call one command, turn a user's error into one line."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from pytest_twin import __version__
from pytest_twin.errors import TwinError

COMMANDS: tuple[str, ...] = (
    "init",
    "intake",
    "audit",
    "realize",
    "replay",
    "diagnose",
    "effects",
    "verify",
)
UNUSABLE_INPUT = 2
READER_GONE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit status, or 2 with one line on standard error."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(
        prog="pytest-twin", description="Keep a robot's digital twin trustworthy."
    )
    parser.add_argument("--version", action="version", version=f"pytest-twin {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    # The imports of all take longer than some commands do.
    for name in words[:1] if words and words[0] in COMMANDS else COMMANDS:
        module = importlib.import_module(f"pytest_twin.commands.{name}")
        command = commands.add_parser(name, help=module.HELP, description=module.HELP)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    args = parser.parse_args(words)
    try:
        status: int = args.run(args)
    except TwinError as error:
        print(f"pytest-twin {args.command}: {error}", file=sys.stderr)
        return UNUSABLE_INPUT
    except BrokenPipeError:
        # Whoever read the output has gone (`| head`): what was to be written stands in its files.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_GONE
    except KeyboardInterrupt:
        print(f"pytest-twin {args.command}: interrupted; nothing was half written", file=sys.stderr)
        return 130
    return status


if __name__ == "__main__":
    raise SystemExit(main())
