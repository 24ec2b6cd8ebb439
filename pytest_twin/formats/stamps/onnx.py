"""Read and write the stamp of an ONNX model: its metadata property ``twin``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError
from pytest_twin.formats import atomic, limits
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import Roots, read_bytes
from pytest_twin.formats.stamps.base import NAME


@dataclass(frozen=True, slots=True)
class OnnxStamp:
    """A policy or a residual model in ONNX format.

    The digest covers the model without this property, and every file that it refers to.
    """

    path: Path

    def read(self) -> str | None:
        """Return the property's text, or None."""
        found = [entry.value for entry in self._model().metadata_props if entry.key == NAME]
        return str(found[-1]) if found else None

    def write(self, text: str) -> None:
        """Rewrite the file with the property, atomically."""
        model = self._model()
        _drop(model)
        entry = model.metadata_props.add()
        entry.key, entry.value = NAME, text
        atomic.write_bytes(self.path, model.SerializeToString(deterministic=True))

    def digest(self) -> str:
        """Return the SHA-256 of the model's content, hex."""
        model = self._model()
        _drop(model)
        hashed = hashlib.sha256(model.SerializeToString(deterministic=True))
        roots = Roots(self.path.parent)
        for location in sorted(set(_files(model))):
            file = roots.resolve(location, at=self.path, where="external data")
            hashed.update(f"{file_sha256(file)} {location}\n".encode())
        return hashed.hexdigest()

    def _model(self) -> Any:
        try:
            import onnx
            from google.protobuf.message import DecodeError
        except ImportError:
            raise FormatError(
                "ONNX models are read by onnx, which is not installed",
                path=self.path,
                expected="pip install 'pytest-twin[onnx]'",
            ) from None
        data = read_bytes(self.path, limits.STAMPS.onnx_bytes)
        model = onnx.ModelProto()
        try:
            model.ParseFromString(data)
        except DecodeError as error:
            raise FormatError(f"not an ONNX model: {str(error)[:80]}", path=self.path) from None
        # The library returns text that is not UTF-8 as bytes, and cannot write such bytes.
        if not all(isinstance(t, str) for e in model.metadata_props for t in (e.key, e.value)):
            raise FormatError(
                "a metadata property that is not UTF-8 text", path=self.path, expected="UTF-8"
            )
        if not model.ir_version or not model.HasField("graph"):
            raise FormatError(
                "not an ONNX model", path=self.path, expected="a model with a version and a graph"
            )
        return model


def _drop(model: Any) -> None:
    kept = [(entry.key, entry.value) for entry in model.metadata_props if entry.key != NAME]
    del model.metadata_props[:]
    for key, value in kept:
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value


def _files(message: Any) -> Iterator[str]:
    """Yield the files, relative to the model, that a message and all messages in it refer to.

    Tensors occur in graphs, in attributes of nodes, in graphs within nodes, in functions and in
    training steps. A node that contains a compiled model of ONNX Runtime names its file.
    """
    kind = message.DESCRIPTOR.full_name
    if kind == "onnx.TensorProto":
        yield from (entry.value for entry in message.external_data if entry.key == "location")
        return
    if kind == "onnx.NodeProto" and message.op_type == "EPContext":
        attributes = {attribute.name: attribute for attribute in message.attribute}
        embedded = attributes["embed_mode"].i if "embed_mode" in attributes else 1
        if not embedded and "ep_cache_context" in attributes:
            yield attributes["ep_cache_context"].s.decode("utf-8", "replace")
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in [value] if hasattr(value, "DESCRIPTOR") else value:
                yield from _files(part)
