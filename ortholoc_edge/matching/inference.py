"""One graph in an ONNX Runtime session, its failures put into our words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from ortholoc_edge.errors import ModelError
from ortholoc_edge.geometry.arrays import Float32Array
from ortholoc_edge.matching import providers
from ortholoc_edge.matching.models import check_hash


class Inference:
    """A session of its own for one graph, computed by the provider in force (`providers.computed_by`).

    Args:
        graph: ONNX bytes; or a file, whose hash the caller has compared (weights beyond protobuf's limit lie in a
            second file beside it).
        sha256: that they must have.
        threads: of one inference. Two one-thread sessions on two images beat one with two threads.
        what: the graph's name in messages.
        model: its name for ``models build``.
        inputs: all of the graph's, in its order; None: whatever it has.
        outputs: those that `run` gives.
    Attributes:
        input_shapes: of the graph, by name, in its order; what may vary is a text.
    Raises: ModelError if the hash differs, or the runtime does not take the graph, or it is another one.
    """

    def __init__(
        self,
        graph: bytes | Path,
        sha256: str,
        threads: int,
        *,
        what: str,
        model: str,
        inputs: Sequence[str] | None,
        outputs: Sequence[str],
    ) -> None:
        self._what = what
        self._remedy: Final = f"build it again with `ortholoc-edge models build {model}`"
        self._outputs = list(outputs)
        if isinstance(graph, bytes):
            check_hash(graph, sha256, f"{what} graph", self._remedy)
        # ONNX Runtime's exceptions share no base but Exception.
        try:
            self._session = ort.InferenceSession(
                graph if isinstance(graph, bytes) else str(graph),
                _options(threads),
                providers=providers.for_session(threads),
            )
        except Exception as err:
            raise ModelError(
                f"{what} graph can't be loaded by onnxruntime {ort.__version__} ({err}); {self._remedy}"
            ) from err
        providers.check_taken(self._session.get_providers(), what)
        self.input_shapes = {entry.name: tuple(entry.shape) for entry in self._session.get_inputs()}
        found_in = self.inputs
        found_out = {entry.name for entry in self._session.get_outputs()}
        expected_in = found_in if inputs is None else list(inputs)
        if found_in != expected_in or not found_out.issuperset(outputs):
            raise ModelError(
                f"{what} graph: inputs {found_in} and outputs {sorted(found_out)}, "
                f"expected {expected_in} and {self._outputs}; this is another model's file"
            )

    @property
    def inputs(self) -> list[str]:
        """Names, in the graph's order."""
        return list(self.input_shapes)

    def run(self, feeds: Mapping[str, npt.NDArray[Any]], subject: str) -> list[Float32Array]:
        """The outputs, in the order given to the constructor.

        Args:
            subject: what it runs on, for messages.
        Raises: ModelError if the runtime fails.
        """
        try:
            outputs = self._session.run(self._outputs, dict(feeds))
        except Exception as err:
            raise ModelError(
                f"{self._what} inference failed on {subject} ({err}); check memory, then {self._remedy}"
            ) from err
        return [np.asarray(output, dtype=np.float32) for output in outputs]


def _options(threads: int) -> Any:
    options = ort.SessionOptions()
    options.intra_op_num_threads = providers.session_threads(threads)
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    # The arena keeps the largest inference's memory for ever and buys no time here (shared notes).
    options.enable_cpu_mem_arena = False
    # Waiting threads would burn the core that the link to the autopilot runs on.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # what fails is raised, too
    return options
