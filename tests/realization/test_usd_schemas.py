"""OpenUSD with the schemas of other packages."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from model_texts import ARM, written

STAGE = """#usda 1.0
(
    defaultPrim = "box"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "box" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{
}
"""
SCRIPT = """
import sys
from pathlib import Path
from pytest_twin.audit import read_usd
from pytest_twin.realization import usd
folder = Path(sys.argv[1])
read_usd.read(folder / "box.usda")
usd.convert(folder / "arm.urdf", folder / "arm.usda")
"""


@pytest.mark.skipif(
    importlib.util.find_spec("urdf_usd_converter") is None, reason="needs the extra usd"
)
def test_a_urdf_is_converted_after_a_stage_was_audited_in_the_same_process(tmp_path: Path) -> None:
    """OpenUSD ignores schemas that are registered after the first stage of a process."""
    written(tmp_path, ARM, "arm.urdf")
    (tmp_path / "box.usda").write_text(STAGE)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "arm.usda").is_file()
