"""``pytest-twin completion``: print a script with which a shell completes the command line.

shtab generates a static script. A dynamic completer would start the program at every key press.
"""

from __future__ import annotations

import argparse
import sys

EXAMPLES = (
    'eval "$(pytest-twin completion bash)"                # in ~/.bashrc',
    "pytest-twin completion zsh > ~/.zfunc/_pytest-twin    # a folder of zsh's fpath",
    "pytest-twin completion fish > ~/.config/fish/completions/pytest-twin.fish",
)
EXIT_STATUS = {0: "the script is on standard output"}
SHELLS = ("bash", "zsh", "fish")
JSON = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "shell", metavar="SHELL", choices=SHELLS, help=f"one of {', '.join(SHELLS)}"
    )


def run(args: argparse.Namespace) -> int:
    """Print the script; return 0."""
    import shtab

    sys.stdout.write(shtab.complete(args.every_command(), args.shell) + "\n")
    return 0
