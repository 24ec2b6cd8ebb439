"""The sampler and the configurations that are written beside ``ranges.json``."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from ranges_files import MEANS, NAMES, STD, covariance, make_twin, record

from pytest_twin.ranges.files import FILES, write_files
from pytest_twin.ranges.run import ranges_of_file

APART = "import sys; sys.modules['pytest_twin'] = sys.modules['scipy'] = None\n"


def written(folder: Path, matrix: np.ndarray, more: str = "") -> Path:
    """``ranges.json`` of the arm and the files beside it."""
    twin = make_twin(folder, [record(matrix)], more)
    (folder / "ranges.json").write_text(json.dumps(ranges_of_file(str(twin))))
    write_files(folder)
    return folder


def sampled(folder: Path, count: int = 10_000) -> dict[str, np.ndarray]:
    """Robots of the sampler, which runs where neither this package nor scipy can be imported."""
    code = APART + (
        "import numpy as np; from sampler import Ranges; ranges = Ranges.load()\n"
        f"robots = ranges.draw({count}, seed=1)\n"
        "fields = {f'{k}.{i}': v for k, f in ranges.mujoco_fields(robots).items()"
        " for i, v in f.items()}\n"
        "np.savez('robots.npz', **robots, **fields)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=60)
    with np.load(folder / "robots.npz") as found:
        return dict(found)


def assert_possible(robots: dict[str, np.ndarray]) -> None:
    """No robot of these that cannot be built."""
    for name, values in robots.items():
        assert np.isfinite(values).all(), name
        if name.endswith(("friction", "armature", "mass", "delay")):
            assert (values > 0.0).all(), name
        if name.endswith(".inertia"):
            # Moments about the centre of mass: positive, and none beyond the sum of the others.
            moments = np.linalg.eigvalsh(values)
            assert (moments > 0.0).all()
            assert (moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1.0 + 1e-9)).all()
        if name.startswith("body_inertia."):
            low, middle, high = np.sort(values, axis=1).T
            assert (low > 0.0).all()
            assert (high <= low + middle).all()


def test_no_impossible_robot_among_10_000(tmp_path: Path) -> None:
    robots = sampled(written(tmp_path, covariance()))
    assert len(robots["fore.mass"]) == 10_000
    assert_possible(robots)
    # As far as they say: the friction of the record, with its correlation.
    friction = robots["shoulder.viscous_friction"], robots["shoulder.coulomb_friction"]
    assert np.corrcoef(friction)[0, 1] == pytest.approx(-0.6, abs=0.03)
    for at, name in enumerate(NAMES[:6]):
        assert robots[name].mean() == pytest.approx(MEANS[at], abs=0.05 * STD[at])
        assert robots[name].std() == pytest.approx(STD[at], rel=0.05)


def test_no_impossible_robot_where_deviations_exceed_the_values(tmp_path: Path) -> None:
    more = "ranges:\n  tolerance:\n  - {parameter: fore.mass, relative: 2}\n"
    more += "  - {parameter: elbow.command_delay, absolute: 0.02}\n"
    robots = sampled(written(tmp_path, covariance(15.0), more))
    assert robots["elbow.viscous_friction"].std() > 0.5
    assert np.quantile(robots["fore.mass"], 0.95) > 3.0
    assert_possible(robots)


def test_moment_and_inertia_of_the_link_keep_the_record_s_covariance(tmp_path: Path) -> None:
    """Base parameters of drawn bodies: through the whole chain of coordinates."""
    small = covariance(0.2)
    robots = sampled(written(tmp_path, small))
    upper, fore = (
        {k: robots[f"{body}.{k}"] for k in ("mass", "com", "inertia")} for body in ("upper", "fore")
    )
    moment = fore["mass"] * fore["com"][:, 0]
    own = fore["inertia"][:, 1, 1] + fore["mass"] * (fore["com"][:, [0, 2]] ** 2).sum(axis=1)
    # What the second link's mass does to the first joint, the first link takes back.
    rest = upper["mass"] * upper["com"][:, 0] + 0.4 * fore["mass"]
    found = np.cov(np.stack([moment, own]))
    assert found == pytest.approx(small[6:, 6:], rel=0.1)
    # To first order: what is left are squares of a deviation of 1 %.
    assert rest.std() < 0.05 * moment.std()


def test_the_files_parse_and_import_only_what_they_say(tmp_path: Path) -> None:
    write_files(tmp_path)
    allowed = {
        "sampler.py": {"numpy"},
        "mjx_randomize.py": {"numpy", "jax", "sampler"},
        "isaaclab_events.py": {"numpy", "torch", "isaaclab", "sampler"},
        "mjlab_events.py": {"numpy", "torch", "mjlab", "sampler"},
    }
    for name in FILES:
        tree = ast.parse((tmp_path / name).read_text())
        imported = {
            alias.name.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
        } | {
            (node.module or "").split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
        }
        assert imported - set(sys.stdlib_module_names) == allowed[name]


def test_mjx_takes_the_randomization(tmp_path: Path) -> None:
    """Where MJX is installed: a batch of models, each stepped once."""
    pytest.importorskip("jax")
    pytest.importorskip("mujoco.mjx")
    code = APART + (
        "import jax, mujoco; from mujoco import mjx; from mjx_randomize import domain_randomize\n"
        "model = mjx.put_model(mujoco.MjModel.from_xml_path('arm.xml'))\n"
        "batch, axes = domain_randomize(model, jax.random.split(jax.random.PRNGKey(0), 4))\n"
        "data = mjx.make_data(model)\n"
        "step = jax.vmap(lambda m: mjx.step(m, data).qpos, in_axes=(axes,))\n"
        "assert step(batch).shape == (4, 2)\n"
    )
    folder = written(tmp_path, covariance())
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=300)
