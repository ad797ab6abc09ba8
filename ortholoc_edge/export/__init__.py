"""Makes the graphs of `matching.exported` from published weights. Needs the extra ``[export]`` (PyTorch); nothing that
flies imports it."""

from __future__ import annotations

import importlib.util
import sys
from typing import Final

from ortholoc_edge.errors import ModelError

_NEEDED: Final = ("torch", "torchvision", "kornia", "einops", "yacs", "huggingface_hub", "safetensors", "PIL")


def require(name: str) -> None:
    """Raises: ModelError naming the extra if a package that the matcher's export needs is absent."""
    absent = [one for one in _NEEDED if importlib.util.find_spec(one) is None]
    if absent:
        raise ModelError(
            f"matcher {name}: to export it takes PyTorch and what the networks' code imports, and {', '.join(absent)} "
            f"can't be found; `{sys.executable} -m pip install 'ortholoc-edge[export]'`, or copy a built store from "
            "another machine"
        )
