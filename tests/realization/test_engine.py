"""What differs between versions of MuJoCo: rows without ``mujoco.batch``, changed meanings."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.errors import ModelError
from pytest_twin.realization import engine, load, simulate
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.realization.row_loop import RowError, RowLoop

ARM = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<geom type="plane" size="1 1 .1" pos="0 0 -.4"/>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping=".1" frictionloss=".05"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
<body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" stiffness="1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/></body></body></worldbody>
<actuator><position joint="shoulder" kp="40" kv="2" timeconst=".02"/>
<motor joint="elbow" gear="3"/></actuator></mujoco>
"""
DC_MOTOR = """\
<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".1"/></body></worldbody>
<actuator><dcmotor name="drive" joint="hinge" motorconst="0.05" resistance="2" {}/></actuator>
</mujoco>
"""
STEPS = 400
needs_batch = pytest.mark.skipif(
    engine.Batch is RowLoop, reason="compares with mujoco.batch, which this MuJoCo lacks"
)


def controls(rows: int = 3) -> np.ndarray:
    phase = np.linspace(0, 12, STEPS)[None, :, None] * np.arange(1, rows + 1)[:, None, None]
    return 0.5 * np.sin(phase + np.array([0.0, 1.0]))


def rolled(batch: object, inputs: np.ndarray) -> dict[object, np.ndarray]:
    """Records of two calls, so that the second continues where the first ended."""
    spec = mujoco.mjtState.mjSTATE_CTRL.value
    record = ("qpos", "qvel", "qfrc_actuator", int(mujoco.mjtState.mjSTATE_TIME))
    batch.bind("qpos")[:] = [[0.1, -0.2]]  # type: ignore[attr-defined]
    batch.bind("time")[:] = 1.0  # type: ignore[attr-defined]
    with suppress_mujoco_warnings():
        parts = [
            batch.rollout(part.shape[1], np.ascontiguousarray(part), spec, record)  # type: ignore[attr-defined]
            for part in np.array_split(inputs, 2, axis=1)
        ]
    return {item: np.concatenate([part[item] for part in parts], axis=1) for item in record}


@needs_batch
@pytest.mark.parametrize("pushed", [None, 1], ids=["finite", "one row diverges"])
def test_rows_without_a_batch_move_as_in_a_batch(pushed: int | None) -> None:
    inputs = controls()
    if pushed is not None:
        inputs[pushed, 250:, 1] = 1e30
    model = mujoco.MjModel.from_xml_string(ARM)
    loop, batch = RowLoop(model, 3), engine.new_batch(model, 3, 1)
    by_loop, by_batch = rolled(loop, inputs), rolled(batch, inputs)
    for item, values in by_batch.items():
        np.testing.assert_array_equal(by_loop[item], values)
    assert (loop.warning[:, :, 1] > 0).tolist() == (batch.warning[:, :, 1] > 0).tolist()
    assert loop.warning[:, :, 1].any() == (pushed is not None)


@needs_batch
def test_rows_with_their_own_model_fields_move_as_in_a_batch() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    motions = []
    for rows in (RowLoop(model, 3), engine.new_batch(model, 3, 1)):
        rows.expand("dof_damping")[:] += [[0.0, 0.0], [0.5, 0.0], [0.0, 2.0]]
        rows.expand("body_mass")[:, 2] *= [1.0, 2.0, 0.5]
        rows.expand("opt.gravity")[1, 0] = 3.0
        rows.set_const()
        qpos, load = rows.bind("qpos"), rows.bind("qfrc_bias")
        ctrl = rows.bind("ctrl")
        qpos[:] = [[0.1, -0.2], [0.3, 0.0], [0.0, 0.4]]
        rows.forward()
        motion = [load.copy()]
        for k in range(60):
            ctrl[:, 0] = 0.1 * k
            rows.expand("dof_frictionloss")[2, 1] = 0.01 * k
            rows.step([0, 2] if k % 3 == 0 else None)
            motion += [qpos.copy(), load.copy(), rows.bind("qvel").copy()]
        out = rows.rollout(40, controls()[:, :40], record=("qpos", "qacc"))
        motions.append([*motion, *out.values(), qpos.copy()])
    for ours, theirs in zip(*motions, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@needs_batch
def test_a_replay_without_a_batch_gives_the_same_numbers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    realization = load(tmp_path / "arm.xml")
    data = mujoco.MjData(realization.model)
    force = np.zeros((3, STEPS, 2))
    by_batch = simulate.simulate_batch(realization.model, data, controls(), force)
    monkeypatch.setattr(engine, "Batch", RowLoop)
    by_loop = simulate.simulate_batch(realization.model, data, controls(), force)
    for ours, theirs in zip(by_loop, by_batch, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


def test_an_error_of_mujoco_in_one_row_leaves_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    loop = RowLoop(model, 2)
    broken = loop._data[0]
    step = mujoco.mj_step

    def step_or_fail(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        if data is broken:
            raise mujoco.FatalError("mj_stackAlloc: out of memory")
        step(model, data)

    monkeypatch.setattr(mujoco, "mj_step", step_or_fail)
    out = {"qpos": np.zeros((2, 5, 2))}
    with pytest.raises(RowError) as caught:
        loop.rollout(5, np.ones((2, 5, 2)), record=("qpos",), out=out)
    assert caught.value.ids == [0]
    assert "out of memory" in loop.error(0)
    assert loop.error(1) == ""
    assert out["qpos"][1].any()


@pytest.mark.parametrize("name", engine._LATER_FIELDS)
def test_a_field_of_a_newer_mujoco_has_its_value_there(name: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><site name="s" pos="0 0 1"/><body><joint name="j"/><geom size=".1"/>
        <site name="t"/></body></worldbody><tendon><fixed><joint joint="j" coef="1"/></fixed>
        <spatial><site site="s"/><site site="t"/></spatial></tendon>
        <keyframe><key/><key/></keyframe></mujoco>"""
    )
    substitute = engine._LATER_FIELDS[name](model)
    np.testing.assert_array_equal(substitute, getattr(model, name, substitute))
    np.testing.assert_array_equal(substitute, engine.model_field(model, name))


def test_a_controller_of_a_dcmotor_is_refused_where_its_gains_are_volts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    older = engine._VERSION < (3, 12)
    monkeypatch.setattr(engine, "_VERSION", (3, 11))
    path = tmp_path / "motor.xml"
    path.write_text(DC_MOTOR.format(f'input="{"position" if older else "pos"}" controller="9 0 1"'))
    with pytest.raises(ModelError, match=r"actuator 'drive': MuJoCo 3\.12 changed .*mujoco>=3\.12"):
        load(path)
    path.write_text(DC_MOTOR.format(""))
    assert load(path).model.nu == 1


@pytest.mark.parametrize(
    ("element", "version", "advice"),
    [
        ('<pid name="drive" joint="hinge" kp="1"/>', (3, 11), "a newer one has it"),
        ('<dcmotor joint="hinge" motorconst="1" resistance="2" input="position"/>', (3, 17),
         "since MuJoCo 3.12 the inputs of a dcmotor"),
    ],
)  # fmt: skip
def test_a_word_of_another_version_is_refused_with_that_version(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    element: str,
    version: tuple[int, int],
    advice: str,
) -> None:
    monkeypatch.setattr(engine, "_VERSION", version)
    if "pid" in element:  # a word that no installed version knows
        element = element.replace("pid", "pidd")
    elif engine.GAIN_PID < 0:
        pytest.skip("this MuJoCo knows the input")
    path = tmp_path / "arm.xml"
    path.write_text(re.sub("<dcmotor.*/>", element, DC_MOTOR))
    with pytest.raises(ModelError, match=re.escape(advice)):
        load(path)
