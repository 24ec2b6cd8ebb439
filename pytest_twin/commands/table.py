"""All commands, in groups; the first page of the help is made without importing one of them."""

from __future__ import annotations

from collections.abc import Mapping

GROUPS: Mapping[str, Mapping[str, str]] = {
    "asset and twin": {
        "intake": "copy a supplier's archive or folder unchanged, with a digest of every file",
        "audit": (
            "check a robot's URDF, MJCF or USD file, or an SRDF against its URDF, and "
            "list faults, doubtful values and unknown properties"
        ),
        "audit-changes": (
            "audit the robots of a git checkout that a change affects, without findings accepted "
            "earlier"
        ),
        "realize": (
            "convert a URDF to a normalized URDF, MJCF and USD, and list what each conversion loses"
        ),
        "init": (
            "set up a twin for a robot's URDF or MJCF file: twin.yaml and recorded "
            "golden specs; or propose the goldens of a twin anew, after its drives or "
            "its model changed"
        ),
    },
    "gate and releases": {
        "verify": "check signature, all digests and age of a release, or the stamp of a data set",
        "stamp": (
            "write the IDs of a release, with digests and signature, into a data set or policy"
        ),
        "fresh": (
            "list changes of the twin since a data set was stamped, and whether they "
            "affect its data"
        ),
        "rollback": "restore the files of the last signed release of a twin",
    },
    "recordings and diagnosis": {
        "show": "summarize a recording: topics, joints, rates, gaps, and missing data",
        "check-dataset": (
            "check a LeRobot data set: units, leader against follower, clock, lost "
            "frames, limits, drift and moved cameras"
        ),
        "convert": (
            "write recordings of any kind as MCAP files with joint states and joint commands"
        ),
        "replay": (
            "simulate a model under a recording's commands, open loop, and write the "
            "predicted states"
        ),
        "diagnose": (
            "name the physics that a model lacks, fit it, and measure the gain on held-"
            "out recordings"
        ),
        "export": (
            "write the findings of a diagnosis, or a twin, as another simulator takes them, with a "
            "matrix of what is lost"
        ),
        "servo": ("list and show identified servos, and add the drive of a diagnosed joint"),
        "trend": (
            "follow parameters and errors of a robot over dated recordings, with change points "
            "and alarms"
        ),
        "effects": (
            "list the physical effects that a diagnosis can name, with laws, parameters and sources"
        ),
    },
    "from calibration to training and adaptation": {
        "calibrate": (
            "estimate joint zeros, link geometry and the frames around a robot from observations"
        ),
        "excite": (
            "design motions for identification within approved limits, and predict their results"
        ),
        "identify": (
            "identify masses, inertia, friction and drives in stages, each tested on "
            "held-out motion"
        ),
        "budget": (
            "write the error budget of a twin: how far each measured uncertainty moves "
            "the task's frame"
        ),
        "randomize": (
            "write randomization ranges of a twin from its records, and check them on "
            "final recordings"
        ),
        "shadow": (
            "compare a candidate with a release on recordings: metrics, safety, injected faults"
        ),
    },
    "first steps": {
        "demo": "copy a demo robot with its tests, and a failing test with its diagnosis",
    },
    "shell": {
        "completion": (
            "print a script that completes pytest-twin's commands and options in your shell"
        ),
    },
}
"""Title on the first page of the help -> command -> what it does, in the order of use."""

COMMANDS: Mapping[str, str] = {
    name: does for commands in GROUPS.values() for name, does in commands.items()
}
"""Command -> what it does."""
