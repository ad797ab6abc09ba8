"""The published networks' own code, where no maintained package has it: read from a pinned wheel, never installed."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

import torch

from ortholoc_edge.matching.models import PinnedWheel, fetched_wheel, given_wheel

_FOLDER: Final = "vismatch/third_party"


@dataclass(frozen=True, slots=True)
class _Vismatch:
    """The wheel that bundles the projects' code, for the matcher that it is fetched for."""

    name: str
    package: str = "vismatch"
    version: str = "1.4.0"
    wheel_sha256: str = "f78784e0a5540e68459ebcea577340b97788b5f2816d080458f8ef21f05117cc"


def vismatch(name: str) -> PinnedWheel:
    return _Vismatch(name)


@contextlib.contextmanager
def project_code(
    name: str,
    project: str,
    into: Path,
    wheel: Path | None,
    roots: Sequence[str] = ("",),
    unused: Sequence[str] = (),
    moved: Mapping[str, str] | None = None,
) -> Iterator[Path]:
    """The code of ``project`` importable while this lasts, and forgotten afterwards: several of them call themselves
    ``src``.

    Args:
        name: of the matcher, for messages.
        project: folder of the wheel's ``third_party``.
        into: folder to unpack to.
        wheel: a copy of the pinned wheel; None lets pip fetch it.
        roots: folders inside the project that its imports begin at.
        unused: packages that its modules import but the network never calls (logging, training, drawing); empty ones
            stand for them.
        moved: modules that its imports seek, and where they are today.
    Raises: ModelError if the wheel can't be had or is another one.
    """
    pinned = vismatch(name)
    data = fetched_wheel(pinned) if wheel is None else given_wheel(pinned, wheel)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        archive.extractall(into, [item for item in archive.namelist() if item.startswith(f"{_FOLDER}/{project}/")])
    folder = into / _FOLDER / project
    stand_ins: dict[str, Any] = {one: mock.MagicMock(name=one) for one in unused}
    stand_ins |= {old: importlib.import_module(new) for old, new in (moved or {}).items()}
    stand_ins = {one: module for one, module in stand_ins.items() if one not in sys.modules}
    path, known = list(sys.path), set(sys.modules)
    sys.path[:0] = [str(folder / root) for root in roots]
    sys.modules.update(stand_ins)
    try:
        yield folder
    finally:
        sys.path[:] = path
        # Not all that is new: torch, too, imports some of its own on the way, and only once.
        for added in set(sys.modules) - known:
            if added in stand_ins or str(getattr(sys.modules[added], "__file__", None) or "").startswith(str(into)):
                del sys.modules[added]


@contextlib.contextmanager
def without_loading() -> Iterator[None]:
    """Networks whose constructors fetch or read weights, and load them, come with the weights that they begin with."""

    def nothing(*_: Any, **__: Any) -> dict[str, torch.Tensor]:
        return {}

    with (
        mock.patch("torch.hub.load_state_dict_from_url", nothing),
        mock.patch("torch.load", nothing),
        mock.patch.object(torch.nn.Module, "load_state_dict", nothing),
    ):
        yield
