"""``pytest-twin servo``: list and show identified servos, and add one from a diagnosis."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.errors import TwinError
from pytest_twin.formats import typed
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.servos import library

EXAMPLES = (
    "pytest-twin servo list",
    "pytest-twin servo show sts3215",
    "pytest-twin servo add diagnosis --id my_servo --joint elbow",
)
EXIT_STATUS = {0: "the servos are printed, or the servo is added"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("action", choices=("list", "show", "add"), help="what to do")
    parser.add_argument(
        "name",
        metavar="SERVO|DIAGNOSIS",
        nargs="?",
        help="with show: id of a servo; with add: folder that diagnose wrote",
    )
    parser.add_argument("--id", metavar="NAME", help="with add: id of the new servo")
    parser.add_argument(
        "--joint", metavar="JOINT", help="with add: its joint (default: the only one with a drive)"
    )
    parser.add_argument(
        "--condition",
        metavar="NAME=TEXT",
        action="append",
        default=[],
        help="with add: a condition of the recordings, such as supply='12 V'; may be repeated",
    )
    parser.add_argument(
        "--library",
        metavar="FILE.yaml",
        type=Path,
        help="with add: file of your servos (default: the environment variable "
        f"{library.VARIABLE}, else ~/.config/pytest-twin/servos.yaml)",
    )
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """List, show or add; return 0.

    Raises:
        TwinError: there is no such servo, or the diagnosis cannot be used.
    """
    if args.action == "list":
        known = library.servos()
        json_output.give(args, {"schema": 1, "servos": [typed.plain(s) for s in known.values()]})
        show_lines(f"{s.id}: {s.maker} {s.model}" for s in known.values())
        return DONE
    if args.name is None:
        raise TwinError(
            "nothing to do it with", where="SERVO|DIAGNOSIS",
            expected="the id of a servo to show, the folder of a diagnosis to add",
        )  # fmt: skip
    if args.action == "show":
        servo = library.find(args.name)
        json_output.give(args, {"schema": 1, "servos": [typed.plain(servo)]})
        show_lines(library.page(servo).splitlines())
        return DONE
    return _add(args)


def _add(args: argparse.Namespace) -> int:
    if args.id is None or not args.id.replace("_", "").replace("-", "").isalnum():
        raise TwinError(
            "no id of the new servo", where="--id", value=args.id,
            expected="letters, digits, - and _",
        )  # fmt: skip
    conditions = {}
    for text in args.condition:
        name, sign, value = text.partition("=")
        if not sign or not name:
            raise TwinError(
                "no condition", where="--condition", value=text, expected="NAME=TEXT, supply=12V"
            )
        conditions[name] = value
    with Sandbox() as sandbox:
        data = sandbox.call(
            "pytest_twin.commands.servo:servo_of",
            {
                "source": str(Path(args.name).resolve()),
                "joint": args.joint,
                "name": args.id,
                "conditions": conditions,
            },
        )
    servo = typed.build(data, library.Servo)
    path = args.library or library.user_library()
    library.add(servo, path)
    json_output.give(args, {"schema": 1, "servos": [data]})
    show(f"{path}: {servo.id} added")
    return DONE


def servo_of(
    source: str, joint: str | None, name: str, conditions: dict[str, str]
) -> dict[str, Any]:
    """The servo of one joint of a diagnosis, JSON-able; runs in the child process.

    Raises:
        TwinError: the diagnosis cannot be read, or the joint has no drive with a linear law.
    """
    from pytest_twin.export.servo_entry import servo_entry
    from pytest_twin.export.source import read_source

    entry = servo_entry(read_source(Path(source)), joint, name, conditions)
    plain: dict[str, Any] = typed.plain(entry)
    return plain


__all__ = ["add_arguments", "run", "servo_of"]
