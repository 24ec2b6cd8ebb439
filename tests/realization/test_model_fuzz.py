"""Damaged models either load or raise a typed error."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_texts import ARM, PENDULUM
from test_mjcf_loading import binary_stl
from test_reference import FULL_MODEL

from pytest_twin.realization import Sandbox

FULL = FULL_MODEL.format(
    angle="radian", eulerseq="xyz", extra="", euler="0.1 0.2 0.3", angle_value="0.5"
).replace("<worldbody>", "<asset><mesh file='tip.stl'/></asset><worldbody>", 1)
ACTUATED = PENDULUM.replace(
    "</mujoco>",
    "<equality><joint joint1='swing'/></equality><tendon><fixed name='t'><joint joint='swing'"
    " coef='1'/></fixed></tendon><sensor><jointpos joint='swing' nsample='3'/></sensor>"
    "<keyframe><key qpos='0.1'/></keyframe></mujoco>",
)
ODD_NUMBERS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-1",
    "0",
    "1e308",
    "-1e308",
    "1e-320",
    "1e10",
    "99999999999999999999",
    "0x10",
    "1_0",
    "",
    "a",
    "1 2 3 4 5 6 7 8",
    "٣",
]
ODD_TEXT = [
    "<",
    ">",
    "&",
    "'",
    '"',
    "\x01",
    "é",
    "<!--",
    "]]>",
    "<?x?>",
    "<body>",
    "</body>",
    "<include file='model.xml'/>",
    "<joint type='free'/>",
    "<link name='upper'/>",
]


@st.composite
def damaged(draw: st.DrawFn, whole: str) -> str:
    text = whole
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["number", "word", "cut", "double", "insert", "swap"]))
        if kind in ("number", "word"):
            pattern = r"-?\d+\.?\d*(e-?\d+)?" if kind == "number" else r"[A-Za-z_]\w+"
            found = list(re.finditer(pattern, text))
            if found:
                match = draw(st.sampled_from(found))
                others = ODD_NUMBERS if kind == "number" else [m.group() for m in found]
                new = draw(st.sampled_from(others))
                text = text[: match.start()] + new + text[match.end() :]
            continue
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(1, 120)))
        if kind == "cut":
            text = text[:start] + text[end:]
        elif kind == "double":
            text = text[:end] + text[start:]
        elif kind == "insert":
            text = text[:start] + draw(st.sampled_from(ODD_TEXT)) + text[start:]
        else:
            lines = text.split("\n")
            a, b = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            lines[a], lines[b] = lines[b], lines[a]
            text = "\n".join(lines)
    return text


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(seconds=20, memory_bytes=6 * 2**30) as found:
        yield found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fuzz")
    (made / "tip.stl").write_bytes(binary_stl())
    return made


def outcome(sandbox: Sandbox, text: str, folder: Path, suffix: str) -> str | None:
    arguments = {"text": text, "folder": str(folder), "suffix": suffix}
    answer = sandbox.call("sandboxed:load_text", arguments)
    if answer is None:
        return None
    words, path = answer
    assert "\n" not in words
    assert path is not None
    assert path.startswith(str(folder))
    return str(words)


@pytest.mark.parametrize(
    ("text", "suffix"), [(FULL, ".xml"), (ACTUATED, ".xml"), (PENDULUM, ".xml"), (ARM, ".urdf")]
)
def test_the_undamaged_models_load(sandbox: Sandbox, folder: Path, text: str, suffix: str) -> None:
    assert outcome(sandbox, text, folder, suffix) is None


FUZZ = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@FUZZ
@given(text=st.sampled_from([FULL, ACTUATED, PENDULUM]).flatmap(damaged))
def test_damaged_mjcf_loads_or_raises_a_typed_error(
    sandbox: Sandbox, folder: Path, text: str
) -> None:
    outcome(sandbox, text, folder, ".xml")


@FUZZ
@given(text=damaged(ARM))
def test_damaged_urdf_loads_or_raises_a_typed_error(
    sandbox: Sandbox, folder: Path, text: str
) -> None:
    outcome(sandbox, text, folder, ".urdf")


@FUZZ
@given(
    data=st.binary(max_size=400),
    cut=st.integers(0, 400),
    suffix=st.sampled_from([".stl", ".obj", ".dae"]),
)
def test_damaged_meshes_load_or_raise_a_typed_error(
    sandbox: Sandbox, folder: Path, data: bytes, cut: int, suffix: str
) -> None:
    whole = binary_stl()
    content = {".stl": whole[:cut] + data, ".obj": b"v 0 0 0\nf 1 1 1\n" + data, ".dae": data}
    (folder / f"damaged{suffix}").write_bytes(content[suffix])
    shape = f"<collision><geometry><mesh filename='damaged{suffix}'/></geometry></collision>"
    text = ARM.replace('<link name="base"/>', f"<link name='base'>{shape}</link>")
    outcome(sandbox, text, folder, ".urdf")
    mjcf = FULL.replace("tip.stl", f"damaged{suffix}").replace('mesh="tip"', 'mesh="damaged"')
    outcome(sandbox, mjcf, folder, ".xml")
