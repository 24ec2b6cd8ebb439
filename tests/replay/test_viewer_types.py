"""Files for viewers against what Foxglove publishes: schemas of messages, types of layouts."""

from __future__ import annotations

import json
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader

from pytest_twin.formats.viewer_mcap import Comparison, Surface, layout, write_comparison

STUDIO = "@foxglove/studio-base@1.48.0"
"""The components of Foxglove Studio, of which Lichtblick is the open successor."""
MOSAIC = "react-mosaic-component@5.3.0"
"""The arrangement of panels that this version of the studio requires."""
TYPES = """
import type {{ LayoutData }} from "@foxglove/studio-base/src/context/CurrentLayoutContext/actions";
import type {{ PlotConfig }} from "@foxglove/studio-base/src/panels/Plot/types";
import type {{ RendererConfig }} from "@foxglove/studio-base/src/panels/ThreeDeeRender/Renderer";
import type {{ LayerSettingsGrid }} from
  "@foxglove/studio-base/src/panels/ThreeDeeRender/renderables/Grids";
import type {{ LayerSettingsEntity }} from
  "@foxglove/studio-base/src/panels/ThreeDeeRender/renderables/SceneEntities";
type Robots = Partial<Omit<RendererConfig, "layers" | "topics">> & {{
  layers: Record<string, Partial<LayerSettingsGrid>>;
  topics: Record<string, Partial<LayerSettingsEntity>>;
}};
export const layout: LayoutData = {layout};
export const robots: Robots[] = {robots};
export const plots: Partial<Omit<PlotConfig, "title">>[] = {plots};
"""


@pytest.fixture
def comparison() -> Comparison:
    pose = np.tile([0.1, 0, 0, 1.0, 0, 0, 0], (20, 1, 1))
    position = np.linspace(0, 1, 20)
    return Comparison(
        np.arange(20) * 10**8, ("arm",), {"measured": pose, "predicted": pose},
        {"arm": Surface(np.eye(3), np.array([[0, 1, 2]]))},
        {f"joint {k}": np.column_stack([position, position + k]) for k in range(3)},
        np.arange(0, 20, 2), ("arm.xml", b"<mujoco/>"),
    )  # fmt: skip


def npm(folder: Path, *words: str) -> None:
    """Run npm in a folder; the test is skipped where it cannot reach its packages."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("npm or node is not there")
    try:
        done = subprocess.run(
            ["npm", *words], cwd=folder, capture_output=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        pytest.skip(f"npm {' '.join(words)} did not end in time")
    if done.returncode:
        pytest.skip(f"npm {' '.join(words)} fails here")


def test_messages_keep_to_the_published_schemas(comparison: Comparison, tmp_path: Path) -> None:
    npm(tmp_path, "install", "--silent", "--no-audit", "--prefix", ".", "@foxglove/schemas@2.1.0")
    script = 'console.log(JSON.stringify(require("@foxglove/schemas/jsonschema")))'
    run = subprocess.run(["node", "-e", script], cwd=tmp_path, capture_output=True, check=True)
    published: dict[str, Any] = json.loads(run.stdout)
    write_comparison(tmp_path / "view.mcap", comparison)
    checked = set()
    with (tmp_path / "view.mcap").open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages():
            name = schema.name.removeprefix("foxglove.")
            if name != schema.name:
                jsonschema.validate(json.loads(message.data), published[name])
                checked.add(name)
    assert checked == {"FrameTransforms", "SceneUpdate"}


@pytest.mark.nightly
@pytest.mark.parametrize("mistake", [None, "direction", "timestampMethod", "layerId", "paths"])
def test_the_layout_keeps_to_the_published_types(
    comparison: Comparison, tmp_path: Path, mistake: str | None
) -> None:
    npm(tmp_path, "install", "--silent", "--no-audit", "--prefix", ".", "typescript@5")
    for package in (STUDIO, MOSAIC):
        # Their types alone: the dependencies of the studio take gigabytes.
        npm(tmp_path, "pack", "--silent", package)
        name, _, version = package.rpartition("@")
        packed = tmp_path / f"{name.removeprefix('@').replace('/', '-')}-{version}.tgz"
        with tarfile.open(packed) as archive:
            archive.extractall(tmp_path / "unpacked", filter="data")
        (tmp_path / "node_modules" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "unpacked/package").rename(tmp_path / "node_modules" / name)
    written = layout(comparison)
    panels = written["configById"]
    chosen = {
        kind: [panel for name, panel in panels.items() if name.startswith(kind)]
        for kind in ("3D!", "Plot!")
    }
    assert sum(map(len, chosen.values())) == len(panels) == 4
    text = TYPES.format(
        layout=json.dumps(written), robots=json.dumps(chosen["3D!"]),
        plots=json.dumps(chosen["Plot!"]),
    )  # fmt: skip
    if mistake is not None:
        assert f'"{mistake}": ' in text
        text = text.replace(f'"{mistake}": ', f'"{mistake}": 7, "_": ')
    (tmp_path / "layout.ts").write_text(text)
    options = ("--noEmit", "--strict", "--skipLibCheck", "--target", "es2022")
    run = subprocess.run(
        ["npx", "tsc", *options, "--module", "esnext", "--moduleResolution", "bundler",
         "layout.ts"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (run.returncode == 0) == (mistake is None), run.stdout[:2000]
