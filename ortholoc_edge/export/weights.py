"""Files of weights read without running what is in them, and put into networks."""

from __future__ import annotations

import argparse
import pickle
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching.exported import WeightsFile

# What published checkpoints wrap their tensors in, and put before their names.
_WRAPPERS: Final = ("state_dict", "model", "model_state_dict")
# What torch and safetensors raise on bytes that are damaged or of another kind.
_DAMAGED: Final = (
    SafetensorError,
    RuntimeError,
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
)
_PREFIXES: Final = ("matcher.", "model.")


def read_weights(path: Path, file: WeightsFile) -> dict[str, torch.Tensor]:
    """Tensors by name, without what the project wraps them in.

    Raises: ModelError for a file that can't be read, is damaged, or holds more than tensors and plain values.
    """
    try:
        if path.suffix == ".safetensors":
            entries: Any = load_file(path)
        else:
            # Checkpoints of DUSt3R and MASt3R keep the training's arguments, too: a class of plain values.
            with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
                # Of a pickle of another kind: whether it can be read shows by itself.
                warnings.simplefilter("ignore")
                entries = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as err:
        raise ModelError(f"weights {path} can't be read ({err.strerror or err}); check the path") from err
    except _DAMAGED as err:
        raise ModelError(
            f"weights {path} can't be read as plain tensors ({str(err).splitlines()[0] if str(err) else err!r}); use "
            f"{file.file} of {file.project}"
        ) from err
    for wrapper in _WRAPPERS:
        if isinstance(entries, Mapping) and isinstance(entries.get(wrapper), Mapping):
            entries = entries[wrapper]
            break
    if not isinstance(entries, Mapping) or not entries:
        raise ModelError(f"weights {path}: no tensors by name are in it; use {file.file} of {file.project}")
    tensors = {}
    for name, value in entries.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise ModelError(f"weights {path}: entry {name!r} is no tensor; use {file.file} of {file.project}")
        for prefix in _PREFIXES:
            name = name.removeprefix(prefix)  # noqa: PLW2901
        tensors[name] = value.float() if value.is_floating_point() else value
    return tensors


def take(model: torch.nn.Module, weights: Mapping[str, torch.Tensor], part: str, may_lack: Sequence[str] = ()) -> None:
    """Put ``weights`` into ``model``: all that it has, but for names that begin with one of ``may_lack``.

    Raises: ModelError if one is missing or has another shape.
    """
    try:
        missing = model.load_state_dict(dict(weights), strict=False).missing_keys
    except RuntimeError as err:
        raise ModelError(
            f"weights of {part}: {str(err).splitlines()[-1].strip()}; this is another network's file"
        ) from err
    missing = [
        name for name in missing if not name.endswith("num_batches_tracked") and not name.startswith(tuple(may_lack))
    ]
    if missing:
        raise ModelError(
            f"weights of {part}: {len(missing)} tensors are missing, {missing[0]!r} the first; this is another "
            "network's file"
        )
