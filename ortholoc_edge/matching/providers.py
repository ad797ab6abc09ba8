"""What computes the networks: ONNX Runtime's execution providers, by our names.

The choice holds for the sessions that are made while it is in force (`computed_by`), whichever networks a matcher
consists of. That includes those that compare a graph with its published model (`models.verify`), so a provider that
computes something else is refused before it flies.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Final, Literal

from ortholoc_edge.errors import ConfigError, ModelError

ProviderName = Literal["cpu", "xnnpack", "cuda", "tensorrt", "openvino"]
CPU: Final = "cpu"

_GPU_PACKAGE: Final = "the package onnxruntime-gpu (on a Jetson: NVIDIA's build of it for the installed JetPack)"


@dataclass(frozen=True, slots=True)
class _Provider:
    """
    Attributes:
        names: ONNX Runtime's, the wanted one first; the others compute the operators that it lacks.
        comes_with: what to install where it is missing.
    """

    names: tuple[str, ...]
    comes_with: str


_PROVIDERS: Final[dict[str, _Provider]] = {
    CPU: _Provider(("CPUExecutionProvider",), "the package onnxruntime"),
    "xnnpack": _Provider(
        ("XnnpackExecutionProvider", "CPUExecutionProvider"),
        "a build of onnxruntime with --use_xnnpack, which the packages for Linux are not",
    ),
    "cuda": _Provider(("CUDAExecutionProvider", "CPUExecutionProvider"), _GPU_PACKAGE),
    "tensorrt": _Provider(
        ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"), f"{_GPU_PACKAGE} and TensorRT"
    ),
    "openvino": _Provider(
        ("OpenVINOExecutionProvider", "CPUExecutionProvider"), "the packages onnxruntime-openvino and openvino"
    ),
}
NAMES: Final = tuple(_PROVIDERS)

_chosen: ContextVar[str] = ContextVar("provider", default=CPU)


@contextmanager
def computed_by(name: str) -> Iterator[None]:
    """Sessions made in this context are the provider's.

    Raises: ConfigError if the installed runtime does not have it.
    """
    require(name)
    token = _chosen.set(name)
    try:
        yield
    finally:
        _chosen.reset(token)


def require(name: str) -> None:
    """Raises: ConfigError naming what there is and the remedy, if the installed runtime lacks a provider."""
    if name not in _PROVIDERS:
        raise ConfigError(f"provider {name!r} is not known; known are: {', '.join(NAMES)}")
    if name == CPU:
        return
    # Not at the top: structural matching flies without the runtime.
    import onnxruntime as ort

    there = set(ort.get_available_providers())
    if _PROVIDERS[name].names[0] not in there:
        ours = [own for own, provider in _PROVIDERS.items() if provider.names[0] in there]
        raise ConfigError(
            f"provider {name!r} is not in the installed onnxruntime {ort.__version__}, which has {', '.join(ours)}; "
            f"install {_PROVIDERS[name].comes_with} in place of that onnxruntime, or choose one that it has"
        )


def chosen() -> str:
    return _chosen.get()


def for_session(threads: int) -> list[tuple[str, dict[str, Any]]]:
    """The chosen provider and those behind it, with their options, as a session takes them."""
    options: dict[str, dict[str, Any]] = {
        "XnnpackExecutionProvider": {"intra_op_num_threads": str(threads)},
        # Its default is 10 bits of mantissa in products.
        "CUDAExecutionProvider": {"use_tf32": "0"},
        # Its default is what the processor likes best, which may be bfloat16.
        "OpenVINOExecutionProvider": {"device_type": "CPU", "num_of_threads": str(threads), "precision": "ACCURACY"},
    }
    return [(name, options.get(name, {})) for name in _PROVIDERS[chosen()].names]


def session_threads(threads: int) -> int:
    """Of the runtime's own pool: a provider that brings a pool of its own would fight with it."""
    return 1 if chosen() == "xnnpack" else threads


def check_taken(taken: list[str], what: str) -> None:
    """The runtime falls back to the processor without a word; we don't.

    Args:
        taken: providers of a session that was made.
        what: the graph, for messages.
    Raises: ModelError if the chosen one is not among them.
    """
    if (wanted := _PROVIDERS[chosen()].names[0]) not in taken:
        raise ModelError(
            f"{what} graph: onnxruntime has {wanted}, but could not start it: its libraries or its device are missing; "
            f"mend that or choose another provider than {chosen()!r}"
        )
