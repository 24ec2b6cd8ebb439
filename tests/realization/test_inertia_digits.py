"""Inertias at the limit of the triangle inequality, with rounding errors."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from model_texts import ARM, written

from pytest_twin.realization import inertia, load, mjcf_file


@pytest.mark.parametrize("moments", [(0.1, 0.7, 0.8), (1e-7, 7e-7, 8e-7)])
def test_a_flat_plate_with_rounded_moments_is_loaded(
    moments: tuple[float, ...], tmp_path: Path
) -> None:
    stated = "ixx='{}' iyy='{}' izz='{}' ixy='0'".format(*moments)
    text = ARM.replace('ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001"', stated)
    assert stated in text
    realization = load(written(tmp_path, text, "arm.urdf"))
    index = realization.frame_index("upper")[1]
    found = np.sort(realization.model.body_inertia[index])
    np.testing.assert_allclose(found, sorted(moments), rtol=1e-14)


def test_a_repaired_inertia_rounded_to_nine_digits_still_compiles() -> None:
    random = np.random.default_rng(7)
    for _ in range(300):
        axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
        broken = axes @ np.diag(random.uniform(1e-4, 1e-3, 3) * [1, 1, 5]) @ axes.T
        stated = [
            float(f"{value:.9g}")
            for value in inertia.six_components(inertia.nearest_consistent(broken))
        ]
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body()
        body.add_joint()
        inertia.write(body, 1.0, np.zeros(3), inertia.tensor(tuple(stated)))
        spec.compile()  # MuJoCo refuses any violation of the triangle inequality


def test_a_written_mjcf_keeps_the_inertia_of_a_thin_body_exactly() -> None:
    """Rounded to six digits, most of these moments violate the triangle inequality."""
    random = np.random.default_rng(8)
    refused = 0
    for _ in range(50):
        small, middle = random.uniform(1e-4, 1e-3, 2)
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="rod")
        body.add_joint()
        axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
        thin = axes @ np.diag([small, middle, (small + middle) * (1.0 - 1e-9)]) @ axes.T
        inertia.write(body, 1.0, np.zeros(3), thin)
        model = spec.compile()
        try:
            mujoco.MjModel.from_xml_string(spec.to_xml())
        except ValueError:
            refused += 1
        again = mujoco.MjModel.from_xml_string(mjcf_file.with_exact_inertia(spec, model))
        np.testing.assert_array_equal(again.body_inertia, model.body_inertia)
    assert refused  # otherwise plain rounding would have been sufficient
