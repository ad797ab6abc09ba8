"""DINOv2's transformer, which DeDoDe and RoMa look through."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any
from unittest import mock

import torch


@contextlib.contextmanager
def shallow(module: ModuleType, layers: int | None) -> Iterator[None]:
    """Transformers that ``module`` makes have ``layers`` layers; None: as many as they ask for."""
    if layers is None:
        yield
        return
    whole = module.DinoVisionTransformer

    def few(*args: Any, **kwargs: Any) -> Any:
        return whole(*args, **{**kwargs, "depth": layers})

    with mock.patch.object(module, "DinoVisionTransformer", few):
        yield


def pin_places(vit: Any, rows: int, columns: int, patch_px: int) -> None:
    """The encoding of places for pictures of this many patches, as a constant: ONNX resizes otherwise (bicubic)."""
    with torch.no_grad():
        tokens = torch.zeros(1, rows * columns + 1, vit.pos_embed.shape[-1])
        # Its (w, h) are a picture's rows and columns.
        places = vit.interpolate_pos_encoding(tokens, rows * patch_px, columns * patch_px).detach().clone()
    vit.interpolate_pos_encoding = lambda *_: places
