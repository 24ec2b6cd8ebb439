"""The ``pytest-twin`` command: parse the arguments, run one command, print errors as one line."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Collection, Sequence

from pytest_twin import __version__
from pytest_twin.commands import json_output, terminal
from pytest_twin.commands.help import UNUSABLE_INPUT, Parser, did_you_mean, epilog, options_of
from pytest_twin.commands.model_files import declared_inputs
from pytest_twin.commands.table import COMMANDS, GROUPS
from pytest_twin.errors import TwinError, of_system
from pytest_twin.formats.declared_inputs import declaring
from pytest_twin.interrupts import sigterm_as_interrupt
from pytest_twin.systems import unsupported_system, unusable_mujoco

BROKEN_PIPE = 141
"""Exit status after SIGPIPE: 128 + 13."""
INTERRUPTED = 130
"""Exit status after SIGINT: 128 + 2."""
_PROGRAM = "pytest-twin"


def parser(commands: Collection[str] = COMMANDS) -> Parser:
    """Argument parser with the options of the named commands; the others are listed in the help."""
    main_parser = Parser(
        prog=_PROGRAM,
        description="Test a robot's digital twin, sign what passes, and name the physics that it "
        "lacks.",
        epilog=f"{_PROGRAM} COMMAND --help shows the options, an example and the exit statuses.\n"
        "The gate itself runs in pytest: pytest --twin-release, pytest --help (group twin).",
        groups=GROUPS,
    )
    main_parser.add_argument("--version", action="version", version=f"{_PROGRAM} {__version__}")
    subparsers = main_parser.add_subparsers(
        title="commands", dest="command", metavar="COMMAND", required=True
    )
    for name, does in COMMANDS.items():
        if name not in commands:
            subparsers.add_parser(name, help=does)
            continue
        module = importlib.import_module(module_of(name))
        command = subparsers.add_parser(
            name,
            help=does,
            description=f"{does[0].upper()}{does[1:]}.",
            epilog=epilog(module.EXAMPLES, module.EXIT_STATUS),
        )
        module.add_arguments(command)
        if getattr(module, "JSON", True):
            json_output.add_argument(command)
        command.set_defaults(run=module.run, parser=command, every_command=parser)
    return main_parser


def module_of(command: str) -> str:
    """Module of a command."""
    return f"pytest_twin.commands.{command.replace('-', '_')}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; unusable input gives 2 and one line of error."""
    if (problem := unsupported_system()) is not None:
        print(problem, file=sys.stderr)
        return UNUSABLE_INPUT
    words = list(sys.argv[1:] if arguments is None else arguments)
    args = _parse(words)
    if (problem := unusable_mujoco()) is not None:
        terminal.show_error(f"{_PROGRAM} {args.command}", problem)
        return UNUSABLE_INPUT
    terminal.take_failure()
    try:
        with (
            sigterm_as_interrupt(),
            json_output.text_stream(args),
            declaring(declared_inputs(args)),
        ):
            status: int = args.run(args)
        json_output.write(args)
        sys.stdout.flush()
        if (failure := terminal.take_failure()) is not None:
            raise failure
    except TwinError as error:
        terminal.show_error(f"{_PROGRAM} {args.command}", str(error))
        return UNUSABLE_INPUT
    except BrokenPipeError:
        # The reader closed the pipe (`| head`); the files are written.
        terminal.discard(sys.stdout)
        return BROKEN_PIPE
    except OSError as error:
        # A disk that is full or read-only, or standard output on one.
        terminal.show_error(f"{_PROGRAM} {args.command}", str(of_system(error)))
        terminal.discard(sys.stdout)
        return UNUSABLE_INPUT
    except KeyboardInterrupt:
        terminal.show_error(f"{_PROGRAM} {args.command}", "interrupted; no file is half written")
        return INTERRUPTED
    return status


def _parse(words: list[str]) -> argparse.Namespace:
    first = words[0] if words else ""
    if first and not first.startswith("-") and first not in COMMANDS:
        Parser(prog=_PROGRAM).error(
            f"there is no command {first!r}{did_you_mean(first, COMMANDS)} "
            f"(commands: {', '.join(COMMANDS)})"
        )
    # Only the module of the named command is imported: importing all takes seconds.
    args, unknown = parser(words[:1] if first in COMMANDS else ()).parse_known_args(words)
    if unknown:
        word = unknown[0]
        args.parser.error(
            f"there is no option or argument {word!r}"
            + did_you_mean(word.split("=")[0], options_of(args.parser))
        )
    return args


if __name__ == "__main__":
    raise SystemExit(main())
