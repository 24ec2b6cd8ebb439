"""A small twin from which releases can be written."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import mujoco

from pytest_twin import release
from pytest_twin.dependency import Part
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.outcome import Measure, Outcome, Reason

MEMBERS = ("asset", "calibration", "fit", "controller", "payload", "validation")
JOINTS = ("shoulder_pan", "elbow_flex")
NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)

MakeRelease = Callable[..., release.Release]


def make_twin(root: Path, name: str = "arm") -> Path:
    (root / "meshes").mkdir(parents=True)
    (root / "golden" / "fk").mkdir(parents=True)
    (root / "twin.yaml").write_text(f"name: {name}\nmodel: arm.xml\n")
    (root / "arm.xml").write_text("<mujoco><worldbody/></mujoco>\n")
    (root / "meshes" / "link.stl").write_bytes(bytes(range(97)))
    (root / "golden" / "fk" / "home.yaml").write_text("kind: fk\n")
    return root


def outcome(status: str = "passed", criticality: str = "critical", error: float = 2e-4) -> Outcome:
    return Outcome(
        golden="golden/fk/home",
        kind="fk",
        realization="mujoco",
        criticality=criticality,
        status=status,  # type: ignore[arg-type]
        measures=(Measure("position", "tcp at home", 0.4, 0.4002, error, 5e-4, "m", "pinocchio"),),
        reasons=(Reason("mujoco/kinematics:link1", "position", "0.1", "0.2"),),
        plot=".twin/plots/home.svg",
        seconds=0.25,
    )


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make_draft(root: Path, *extra: Path, name: str = "arm", result: Outcome | None = None):
    folders = (root, root / "meshes", root / "golden" / "fk")
    files = [path for folder in folders for path in folder.iterdir() if path.is_file()]
    parts = {
        "mujoco/kinematics:link1": Part("mujoco/kinematics:link1", {"position": [0.0, 0.1, 1 / 3]}),
        **{f"mujoco/joint:{name}": Part(f"mujoco/joint:{name}", {}) for name in JOINTS},
        "library:pin": Part("library:pin", {"version": "4.1.0"}),
    }
    return release.Draft(
        twin=name,
        valid_days=90,
        ids={
            "asset": {"arm.xml": "00ff"},
            "controllers": ["kp100"],
            "payloads": ["kg05", "kg10"],
            "parts": {"firmware": "1.8.2"},
            "digests": {name: bytes_sha256(name.encode()) for name in MEMBERS},
        },
        parts=parts,
        proofs=(release.Proof(result or outcome(), "Home pose", tuple(parts)),),
        environment={"python": "CPython 3.11.2", "mujoco": mujoco.__version__},
        files={path: sha256(path) for path in (*files, *extra)},
    )


def html(header: release.Header) -> str:
    return f"<!doctype html><title>release {header.number}</title>"
