"""The stamp of an ONNX model covers every file that the model refers to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pytest_twin.errors import TwinError
from pytest_twin.formats.stamps.onnx import OnnxStamp

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402


def external(location: str = "w.bin") -> Any:
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return tensor


def constant(tensor: Any) -> Any:
    return helper.make_node("Constant", [], ["w"], value=tensor)


def output() -> Any:
    return helper.make_tensor_value_info("w", TensorProto.FLOAT, [2])


def branch(tensor: Any) -> Any:
    return helper.make_graph([constant(tensor)], "branch", [], [output()])


def as_initializer(model: Any) -> None:
    model.graph.initializer.append(external())


def in_constant(model: Any) -> None:
    model.graph.node.append(constant(external()))


def in_list_attribute(model: Any) -> None:
    model.graph.node.append(helper.make_node("Own", [], ["w"], tables=[external()]))


def in_subgraph(model: Any) -> None:
    inner = helper.make_node("If", ["c"], ["w"], then_branch=branch(external()))
    outer = helper.make_graph([inner], "outer", [], [output()])
    model.graph.node.append(helper.make_node("If", ["c"], ["w"], then_branch=outer))


def in_sparse_tensor(model: Any) -> None:
    model.graph.sparse_initializer.add(values=external())


def in_function(model: Any) -> None:
    model.functions.add(name="f", domain="own").node.append(constant(external()))


def in_training(model: Any) -> None:
    model.training_info.add(algorithm=branch(external()))


def in_compiled_context(model: Any) -> None:
    model.graph.node.append(
        helper.make_node("EPContext", [], ["w"], embed_mode=0, ep_cache_context="w.bin")
    )


PLACES = [
    as_initializer, in_constant, in_list_attribute, in_subgraph, in_sparse_tensor, in_function,
    in_training, in_compiled_context,
]  # fmt: skip


def write(folder: Path, add: Callable[[Any], None]) -> OnnxStamp:
    model = helper.make_model(helper.make_graph([], "policy", [], [output()]))
    add(model)
    (folder / "w.bin").write_bytes(bytes(8))
    (folder / "p.onnx").write_bytes(model.SerializeToString())
    return OnnxStamp(folder / "p.onnx")


@pytest.mark.parametrize("add", PLACES)
def test_a_change_of_an_external_file_changes_the_digest(
    add: Callable[[Any], None], tmp_path: Path
) -> None:
    carrier = write(tmp_path, add)
    before = carrier.digest()
    carrier.write("stamp")
    assert carrier.digest() == before
    (tmp_path / "w.bin").write_bytes(bytes(7) + b"\1")
    assert carrier.digest() != before


def test_an_external_file_outside_the_models_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "w.bin").write_bytes(bytes(8))
    carrier = write(folder, lambda m: m.graph.node.append(constant(external("../w.bin"))))
    with pytest.raises(TwinError, match=r"\.\./w\.bin"):
        carrier.digest()


def test_a_missing_external_file_is_refused(tmp_path: Path) -> None:
    carrier = write(tmp_path, as_initializer)
    (tmp_path / "w.bin").unlink()
    with pytest.raises(TwinError, match=r"w\.bin"):
        carrier.digest()
