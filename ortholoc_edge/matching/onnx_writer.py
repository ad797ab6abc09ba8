"""Collects the nodes and weights of an ONNX graph, so that a network can be written down without torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper

from ortholoc_edge.errors import ModelError

BATCH_NORM_EPSILON: Final = 1e-5  # torch's default

_OPSET: Final = 20
_IR_VERSION: Final = 10  # the oldest that holds opset 20, so that older runtimes load the file

# A value's shape: numbers, and names for what may vary.
Shape = Sequence[int | str]


class OnnxWriter:
    """Each method adds one step and returns the name of its output.

    Args:
        weights: the checkpoint's tensors by name.
        what: whose they are, for messages.
    """

    def __init__(self, weights: Mapping[str, npt.NDArray[Any]], what: str) -> None:
        self._weights = weights
        self._what = what
        self._names: set[str] = set()
        self._nodes: list[onnx.NodeProto] = []
        self._initializers: list[onnx.TensorProto] = []

    def weight(self, name: str) -> npt.NDArray[np.float64]:
        """Raises: ModelError if there is none of this name."""
        try:
            return self._weights[name].astype(np.float64)
        except KeyError:
            raise ModelError(
                f"{self._what} weights: tensor {name!r} is missing; this is another network's checkpoint"
            ) from None

    def constant(self, name: str, values: npt.ArrayLike, dtype: npt.DTypeLike) -> str:
        """Kept once: a name that is known already stands for the values of its first use."""
        if name not in self._names:
            self._names.add(name)
            array = np.ascontiguousarray(np.asarray(values, dtype=dtype))
            self._initializers.append(onnx.numpy_helper.from_array(array, name))
        return name

    def node(self, op: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self._nodes.append(helper.make_node(op, inputs, [output], name=output, **attributes))
        return output

    def model(self, name: str, source: str, inputs: Mapping[str, Shape], outputs: Mapping[str, Shape]) -> bytes:
        """The graph as ONNX bytes, all values float32; the same steps and ``onnx`` version give the same bytes.

        Args:
            name: of the graph.
            source: written into the file, says where the weights are from.
        Raises: ModelError if the nodes and weights do not fit each other.
        """
        graph = helper.make_graph(
            self._nodes, name, _values(inputs), _values(outputs), initializer=self._initializers
        )
        model = helper.make_model(
            graph,
            producer_name="ortholoc-edge",
            ir_version=_IR_VERSION,
            opset_imports=[helper.make_opsetid("", _OPSET)],
            doc_string=source,
        )
        try:
            onnx.checker.check_model(model, full_check=True)
        except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as err:
            raise ModelError(
                f"{self._what} weights: they do not form the network ({err}); this is another network's checkpoint"
            ) from err
        return bytes(model.SerializeToString(deterministic=True))


def _values(shapes: Mapping[str, Shape]) -> list[onnx.ValueInfoProto]:
    return [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)) for name, shape in shapes.items()]
