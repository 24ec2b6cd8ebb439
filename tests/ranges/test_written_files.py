"""The sampler and the simulator configurations written next to ``ranges.json``."""

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
from pytest_twin.ranges.ranges_of_twin import ranges_of_file

APART = "import sys; sys.modules['pytest_twin'] = sys.modules['scipy'] = None\n"


def write_ranges(folder: Path, matrix: np.ndarray, more: str = "") -> Path:
    """Write ``ranges.json`` of the arm and the files next to it."""
    twin = make_twin(folder, [record(matrix)], more)
    (folder / "ranges.json").write_text(json.dumps(ranges_of_file(str(twin))))
    write_files(folder)
    return folder


def sample_robots(folder: Path, count: int = 10_000) -> dict[str, np.ndarray]:
    """Robots drawn by the sampler in a process that can import neither this package nor scipy."""
    code = APART + (
        "import numpy as np; from sampler import Ranges; ranges = Ranges.load()\n"
        f"robots = ranges.draw({count}, seed=1)\n"
        "fields = {f'{k}.{i}': v for k, f in ranges.mujoco_fields(robots).items()"
        " for i, v in f.items()}\n"
        "np.savez('robots.npz', **robots, **fields)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=300)
    with np.load(folder / "robots.npz") as found:
        return dict(found)


def assert_physically_possible(robots: dict[str, np.ndarray]) -> None:
    """Parameters are finite and positive, and moments of inertia fulfil the triangle inequality."""
    for name, values in robots.items():
        assert np.isfinite(values).all(), name
        if name.endswith(("friction", "armature", "mass", "delay")):
            assert (values > 0.0).all(), name
        if name.endswith(".inertia"):
            # Moments about the centre of mass are positive, and none exceeds the sum of the others.
            moments = np.linalg.eigvalsh(values)
            assert (moments > 0.0).all()
            assert (moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1.0 + 1e-9)).all()
        if name.startswith("body_inertia."):
            low, middle, high = np.sort(values, axis=1).T
            assert (low > 0.0).all()
            assert (high <= low + middle).all()


def test_10_000_drawn_robots_are_physically_possible_and_follow_the_record(tmp_path: Path) -> None:
    robots = sample_robots(write_ranges(tmp_path, covariance()))
    assert len(robots["fore.mass"]) == 10_000
    assert_physically_possible(robots)
    # The friction has the mean, deviation and correlation of the record.
    friction = robots["shoulder.viscous_friction"], robots["shoulder.coulomb_friction"]
    assert np.corrcoef(friction)[0, 1] == pytest.approx(-0.6, abs=0.03)
    for at, name in enumerate(NAMES[:6]):
        assert robots[name].mean() == pytest.approx(MEANS[at], abs=0.05 * STD[at])
        assert robots[name].std() == pytest.approx(STD[at], rel=0.05)


def test_drawn_robots_are_physically_possible_even_if_deviations_exceed_the_values(
    tmp_path: Path,
) -> None:
    more = "ranges:\n  tolerance:\n  - {parameter: fore.mass, relative: 2}\n"
    more += "  - {parameter: elbow.command_delay, absolute: 0.02}\n"
    robots = sample_robots(write_ranges(tmp_path, covariance(15.0), more))
    assert robots["elbow.viscous_friction"].std() > 0.5
    assert np.quantile(robots["fore.mass"], 0.95) > 3.0
    assert_physically_possible(robots)


def test_first_moment_and_inertia_of_drawn_links_have_the_covariance_of_the_record(
    tmp_path: Path,
) -> None:
    """The base parameters are computed from the mass, centre and inertia of the drawn bodies."""
    small = covariance(0.2)
    robots = sample_robots(write_ranges(tmp_path, small))
    upper, fore = (
        {k: robots[f"{body}.{k}"] for k in ("mass", "com", "inertia")} for body in ("upper", "fore")
    )
    moment = fore["mass"] * fore["com"][:, 0]
    own = fore["inertia"][:, 1, 1] + fore["mass"] * (fore["com"][:, [0, 2]] ** 2).sum(axis=1)
    # The first link compensates the effect of the second link's mass on the first joint.
    rest = upper["mass"] * upper["com"][:, 0] + 0.4 * fore["mass"]
    found = np.cov(np.stack([moment, own]))
    assert found == pytest.approx(small[6:, 6:], rel=0.1)
    # It compensates to first order; the remainder is quadratic in a deviation of 1 %.
    assert rest.std() < 0.05 * moment.std()


def test_the_written_files_import_only_their_allowed_packages(tmp_path: Path) -> None:
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


def test_mjx_steps_a_batch_of_randomized_models(tmp_path: Path) -> None:
    """If MJX is installed, a batch of four models is stepped once."""
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
    folder = write_ranges(tmp_path, covariance())
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=300)
