"""Matchers whose weights no package carries: what they are, which files they need, and what `models build` made of
them.

Their graphs are exported by `ortholoc_edge.export` (PyTorch, the extra ``[export]``) from a file of the user's; to run
them takes numpy, OpenCV and ONNX Runtime alone. In the store a matcher is its graphs ``NAME.onnx`` or
``NAME-PART.onnx`` (beside one that is too large for one file its ``.onnx.data``) and ``NAME.json``, the record, written
last. Graphs of random weights, for tests, bear another name, so that nothing can take them for a matcher.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching.models import joint_sha256, model_directory

RANDOM_SUFFIX: Final = "-random-weights"
# A graph whose weights exceed this goes into two files: protobuf's limit is 2 GiB.
MOST_INLINE_BYTES: Final = 1800 << 20

# How a matcher's graphs are run (`matching/pairs.py`, `superpoint.py`, `dedode.py`).
Family = Literal["superpoint", "dedode", "pairs", "warp", "points"]


@dataclass(frozen=True, slots=True)
class WeightsFile:
    """A file of weights as its authors publish it.

    Attributes:
        part: its role, as in ``--weights PART=FILE``.
        file: its published name.
        project: who publishes it.
        address: on the project's own pages; None: they name no lasting one.
        sha256: that the file must have, as at least two projects that use it state it; None: not known to us, so what
            the user gives is taken and its hash recorded.
    """

    part: str
    file: str
    project: str
    address: str | None = None
    sha256: str | None = None


@dataclass(frozen=True, slots=True)
class ExportedMatcher:
    """One entry of the catalogue.

    Attributes:
        name: as in ``--matcher`` and ``models build``.
        family: how its graphs are run.
        files: of weights, in the order that the exporter wants them.
        graphs: parts, each one graph; "" for the only one.
        licence: of the weights, SPDX where there is such.
        non_commercial: whether it forbids commercial use, in whole or of one part.
        note: authors and paper.
        size: (width, height) that the graph is made for, px, where the network asks for one; pictures are stretched to
            it.
        fine_size: the same of a second look at the pictures.
        million_parameters: of all parts.
        contract: what the graphs take and give.
        min_confidence: matches below are left out, as in the published code.
        package: where the network's code is from when it is exported.
    """

    name: str
    family: Family
    files: tuple[WeightsFile, ...]
    licence: str
    non_commercial: bool
    note: str
    million_parameters: float
    contract: str
    package: str
    graphs: tuple[str, ...] = ("",)
    size: tuple[int, int] | None = None
    fine_size: tuple[int, int] | None = None
    min_confidence: float = 0.0


_KEYPOINTS_CONTRACT: Final = (
    "picture: grey (1, 1, H, W) float32 in 0..1, H and W multiples of 8; heat (1, 1, H, W), descriptors "
    "(1, 256, H/8, W/8) unit length"
)
_PAIRS_CONTRACT: Final = (
    "query, reference (1, 1, H, W) float32 grey in 0..1; query_px, reference_px (K, 2), pixel centres at integers, "
    "confidence (K,), 0 where there is no match"
)
_WARP_CONTRACT: Final = (
    "query, reference (1, 1, H, W) float32 grey in 0..1, and both again at the finer size where there is one; warp "
    "(2, H, W, 2): of query and reference, where each pixel lies in the other picture, -1..1 from edge to edge; "
    "certainty (2, H, W)"
)
_POINTS_CONTRACT: Final = (
    "query, reference (1, 1, H, W) float32 grey in 0..1; query_features, reference_features (H, W, D), "
    "query_confidence, reference_confidence (H, W)"
)
_MAGIC_LEAP: Final = "Magic Leap"
_VISMATCH: Final = "vismatch 1.4.0"

_SUPERPOINT_FILE: Final = WeightsFile(
    "superpoint",
    "superpoint_v1.pth",
    "magicleap/SuperGluePretrainedNetwork",
    "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/superpoint_v1.pth",
    "52b6708629640ca883673b5d5c097c4ddad37d8048b33f09c8ca0d69db12c40e",
)
_DINOV2_FILE: Final = WeightsFile(
    "dinov2",
    "dinov2_vitl14_pretrain.pth",
    "facebookresearch/dinov2",
    "https://dl.fbaipublicfiles.com/dinov2/dinov2_vitl14/dinov2_vitl14_pretrain.pth",
    "d5383ea8f4877b2472eb973e0fd72d557c7da5d3611bd527ceeb1d7162cbf428",
)

_ALL: Final = (
    ExportedMatcher(
        name="superpoint-superglue",
        family="superpoint",
        files=(
            _SUPERPOINT_FILE,
            WeightsFile(
                "superglue",
                "superglue_outdoor.pth",
                "magicleap/SuperGluePretrainedNetwork",
                "https://github.com/magicleap/SuperGluePretrainedNetwork/raw/master/models/weights/superglue_outdoor.pth",
                "2f5f5e9bb3febf07b69df633c4c3ff7a17f8af26a023aae2b9303d22339195bd",
            ),
        ),
        licence=_MAGIC_LEAP,
        non_commercial=True,
        note="SuperPoint: DeTone, Malisiewicz, Rabinovich 2018; SuperGlue: Sarlin, DeTone, Malisiewicz, Rabinovich, "
        "CVPR 2020, outdoor weights, 20 Sinkhorn iterations",
        million_parameters=13.3,
        contract=f"{_KEYPOINTS_CONTRACT}; matcher: descriptors (M, 256), places (M, 2) from the image's middle in 0.7 "
        "of its long side, scores (M,) of query and reference; log_assignment (M, N)",
        package=_VISMATCH,
        graphs=("superpoint", "superglue"),
        min_confidence=0.2,
    ),
    ExportedMatcher(
        name="superpoint-lightglue",
        family="superpoint",
        files=(
            _SUPERPOINT_FILE,
            WeightsFile(
                "lightglue",
                "superpoint_lightglue.pth",
                "cvg/LightGlue",
                "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/superpoint_lightglue.pth",
                "6ff7040d0a497fc6639337946d7538dae07428c18f77a067a0b5a960e7cc551a",
            ),
        ),
        licence=f"{_MAGIC_LEAP}; Apache-2.0",
        non_commercial=True,
        note="SuperPoint: DeTone, Malisiewicz, Rabinovich 2018 (Magic Leap's licence); LightGlue: Lindenberger, "
        "Sarlin, Pollefeys, ICCV 2023 (Apache-2.0)",
        million_parameters=13.2,
        contract=f"{_KEYPOINTS_CONTRACT}; matcher: as of `aliked-lightglue`, descriptors (M, 256)",
        package=_VISMATCH,
        graphs=("superpoint", "lightglue"),
        min_confidence=0.1,
    ),
    ExportedMatcher(
        name="dedode",
        family="dedode",
        files=(
            WeightsFile(
                "detector",
                "dedode_detector_L_v2.pth",
                "Parskatt/DeDoDe",
                "https://github.com/Parskatt/DeDoDe/releases/download/v2/dedode_detector_L_v2.pth",
                "4113809dd9e0367af013a45fc2255a6b243ff241cd06520d17a65d9e231bdc17",
            ),
            WeightsFile(
                "descriptor",
                "dedode_descriptor_G.pth",
                "Parskatt/DeDoDe",
                "https://github.com/Parskatt/DeDoDe/releases/download/dedode_pretrained_models/dedode_descriptor_G.pth",
                "ef6e3f2911bb3c179960db15545a2137d0746054bb5bad75559524ccab1fee41",
            ),
            _DINOV2_FILE,
        ),
        licence="MIT; Apache-2.0 (DINOv2)",
        non_commercial=False,
        note="DeDoDe, detector L of version 2 and descriptor G: Edstedt, Bökman, Wadenbring, Felsberg, 3DV 2024",
        million_parameters=337.9,
        contract="picture: grey (1, 1, H, W) float32 in 0..1; detector: heat (1, 1, H, W) logits; descriptor: also "
        "keypoints (N, 2), pixel centres at integers; descriptors (N, 256) unit length",
        package="kornia",
        graphs=("detector", "descriptor"),
        size=(784, 784),
        min_confidence=0.05,
    ),
    ExportedMatcher(
        name="loftr",
        family="pairs",
        files=(WeightsFile("loftr", "outdoor_ds.ckpt", "zju3dv/LoFTR"),),
        licence="Apache-2.0",
        non_commercial=False,
        note="LoFTR, outdoor: Sun, Shen, Wang, Bao, Zhou, CVPR 2021",
        million_parameters=11.6,
        contract=_PAIRS_CONTRACT,
        package="kornia",
        size=(640, 480),
        min_confidence=0.2,
    ),
    ExportedMatcher(
        name="minima-loftr",
        family="pairs",
        files=(
            WeightsFile(
                "loftr",
                "minima_loftr.ckpt",
                "LSXI7/MINIMA",
                "https://github.com/LSXI7/storage/releases/download/MINIMA/minima_loftr.ckpt",
            ),
        ),
        licence="Apache-2.0",
        non_commercial=False,
        note="MINIMA: Ren, Jiang, Li, Liang, Wang, Liu, Liu, CVPR 2025; LoFTR: Sun, Shen, Wang, Bao, Zhou, CVPR 2021",
        million_parameters=11.6,
        contract=_PAIRS_CONTRACT,
        package="kornia",
        size=(640, 480),
        min_confidence=0.2,
    ),
    ExportedMatcher(
        name="eloftr",
        family="pairs",
        files=(
            WeightsFile(
                "eloftr",
                "eloftr_outdoor.ckpt",
                "zju3dv/EfficientLoFTR",
                sha256="0af6291141c736e75e94b7f8aae4399b77c7731b3f08758212b2cfe370188878",
            ),
        ),
        licence="Apache-2.0",
        non_commercial=False,
        note="Efficient LoFTR, full model: Wang, He, Peng, Tan, Zhou, CVPR 2024",
        million_parameters=16.0,
        contract=_PAIRS_CONTRACT,
        package=_VISMATCH,
        size=(640, 480),
        min_confidence=0.2,
    ),
    ExportedMatcher(
        name="xoftr",
        family="pairs",
        files=(WeightsFile("xoftr", "weights_xoftr_640.ckpt", "OnderT/XoFTR"),),
        licence="Apache-2.0",
        non_commercial=False,
        note="XoFTR: Tuzcuoğlu, Köksal, Sofu, Kalkan, Alatan, CVPR workshops 2024",
        million_parameters=11.1,
        contract=_PAIRS_CONTRACT,
        package=_VISMATCH,
        size=(640, 480),
        min_confidence=0.1,
    ),
    ExportedMatcher(
        name="dkm",
        family="warp",
        files=(
            WeightsFile(
                "dkm",
                "DKMv3_outdoor.pth",
                "Parskatt/DKM",
                "https://github.com/Parskatt/storage/releases/download/dkmv3/DKMv3_outdoor.pth",
            ),
        ),
        licence="MIT",
        non_commercial=False,
        note="DKMv3, outdoor: Edstedt, Athanasiadis, Wadenbäck, Felsberg, CVPR 2023",
        million_parameters=70.2,
        contract=_WARP_CONTRACT,
        package=_VISMATCH,
        size=(720, 540),
        fine_size=(1152, 864),
        min_confidence=0.05,
    ),
    ExportedMatcher(
        name="gim-dkm",
        family="warp",
        files=(WeightsFile("dkm", "gim_dkm_100h.ckpt", "xuelunshen/gim"),),
        licence="MIT; for research, says its README",
        non_commercial=True,
        note="GIM (for research, says its README): Shen, Cai, Yin, Müller, Li, Wang, Chen, Wang, ICLR 2024; "
        "DKMv3: Edstedt et al., CVPR 2023",
        million_parameters=70.2,
        contract=_WARP_CONTRACT,
        package=_VISMATCH,
        size=(896, 672),
        fine_size=(1536, 1152),
        min_confidence=0.05,
    ),
    ExportedMatcher(
        name="dust3r",
        family="points",
        files=(
            WeightsFile(
                "dust3r",
                "DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth",
                "naver/dust3r",
                "https://download.europe.naverlabs.com/ComputerVision/DUSt3R/DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth",
            ),
        ),
        licence="CC-BY-NC-SA-4.0",
        non_commercial=True,
        note="DUSt3R: Wang, Leroy, Cabon, Chidlovskii, Revaud, CVPR 2024",
        million_parameters=571.0,
        contract=_POINTS_CONTRACT,
        package=_VISMATCH,
        size=(512, 384),
        min_confidence=3.0,
    ),
    ExportedMatcher(
        name="mast3r",
        family="points",
        files=(
            WeightsFile(
                "mast3r",
                "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
                "naver/mast3r",
                "https://download.europe.naverlabs.com/ComputerVision/MASt3R/"
                "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
            ),
        ),
        licence="CC-BY-NC-SA-4.0",
        non_commercial=True,
        note="MASt3R: Leroy, Cabon, Revaud, ECCV 2024",
        million_parameters=689.0,
        contract=_POINTS_CONTRACT,
        package=_VISMATCH,
        size=(512, 384),
    ),
    ExportedMatcher(
        name="roma",
        family="warp",
        files=(
            WeightsFile(
                "roma",
                "roma_outdoor.pth",
                "Parskatt/RoMa",
                "https://github.com/Parskatt/storage/releases/download/roma/roma_outdoor.pth",
                "c7a45c80d41ad788a63c641d1b686d7cb3f297f40097c6f4e75039889e5cc8ba",
            ),
            _DINOV2_FILE,
        ),
        licence="MIT; Apache-2.0 (DINOv2)",
        non_commercial=False,
        note="RoMa, outdoor: Edstedt, Sun, Bökman, Wadenbäck, Felsberg, CVPR 2024",
        million_parameters=415.7,
        contract=_WARP_CONTRACT,
        package=_VISMATCH,
        size=(560, 560),
        fine_size=(864, 864),
        min_confidence=0.05,
    ),
    ExportedMatcher(
        name="minima-roma",
        family="warp",
        files=(
            WeightsFile(
                "roma",
                "minima_roma.pth",
                "LSXI7/MINIMA",
                "https://github.com/LSXI7/storage/releases/download/MINIMA/minima_roma.pth",
            ),
            _DINOV2_FILE,
        ),
        licence="Apache-2.0",
        non_commercial=False,
        note="MINIMA: Ren, Jiang, Li, Liang, Wang, Liu, Liu, CVPR 2025; RoMa: Edstedt et al., CVPR 2024",
        million_parameters=415.7,
        contract=_WARP_CONTRACT,
        package=_VISMATCH,
        size=(560, 560),
        fine_size=(864, 864),
        min_confidence=0.05,
    ),
)
EXPORTED: Final[dict[str, ExportedMatcher]] = {entry.name: entry for entry in _ALL}


@dataclass(frozen=True, slots=True)
class StoredGraph:
    """A graph whose files have the recorded hashes.

    Attributes:
        path: of the ONNX file.
        sha256: of it, or jointly of it and its data.
    """

    path: Path
    sha256: str


def stored_name(name: str, *, random_weights: bool) -> str:
    return f"{name}{RANDOM_SUFFIX}" if random_weights else name


def graph_file(stored: str, part: str) -> str:
    return f"{stored}-{part}.onnx" if part else f"{stored}.onnx"


def record_path(name: str, *, random_weights: bool = False) -> Path:
    return model_directory() / f"{stored_name(name, random_weights=random_weights)}.json"


def how_to_build(entry: ExportedMatcher) -> str:
    """The command that makes it, with the files' published names."""
    several = len(entry.files) > 1
    weights = "".join(f" --weights {f'{file.part}=' if several else ''}{file.file}" for file in entry.files)
    yes = " --accept-non-commercial" if entry.non_commercial else ""
    return f"ortholoc-edge models build {entry.name}{weights}{yes}"


def where_from(entry: ExportedMatcher) -> str:
    return ", ".join(f"{file.file} from {file.project}" for file in entry.files)


def read_record(name: str, *, random_weights: bool = False) -> dict[str, Any] | None:
    """What `models build` wrote; None where it never did. Raises: ModelError if it can't be read."""
    path = record_path(name, random_weights=random_weights)
    try:
        entries = json.loads(path.read_bytes())
        if not isinstance(entries["files"], dict) or not isinstance(entries["accepted_non_commercial"], bool):
            raise TypeError("an entry has another type")
    except FileNotFoundError:
        return None
    except OSError as err:
        raise ModelError(f"model {name}: {path} can't be read ({err.strerror}); {_again(name)}") from err
    except (ValueError, KeyError, TypeError) as err:
        raise ModelError(f"model {name}: record {path} is damaged ({err!r}); {_again(name)}") from err
    return dict(entries)


def _again(name: str) -> str:
    return f"build it again with `{how_to_build(EXPORTED[name])}`"


def load(name: str, *, random_weights: bool = False) -> list[StoredGraph]:
    """The matcher's graphs, in the catalogue's order, their files compared with the record.

    Raises: ModelError naming the remedy where they were never built, are damaged, or may not be used: a non-commercial
        licence takes the yes that the record keeps.
    """
    entry = EXPORTED[name]
    record = read_record(name, random_weights=random_weights)
    if record is None:
        raise ModelError(
            f"matcher {name} is not built; get {where_from(entry)}, then run `{how_to_build(entry)}` (it takes the "
            "extra 'export')"
        )
    if entry.non_commercial and not record["accepted_non_commercial"]:
        raise ModelError(
            f"matcher {name}: its licence ({entry.licence}) forbids commercial use, and the store keeps no yes to "
            f"that; {_again(name)}"
        )
    stored = stored_name(name, random_weights=random_weights)
    return [_checked(name, graph_file(stored, part), record["files"]) for part in entry.graphs]


def _checked(name: str, file: str, files: dict[str, str]) -> StoredGraph:
    hashes = []
    for one in (file, f"{file}.data"):
        if one not in files:
            if one == file:
                raise ModelError(f"model {name}: its record does not name {file}; {_again(name)}")
            continue
        try:
            actual = file_sha256(model_directory() / one)
        except OSError as err:
            raise ModelError(
                f"model {name}: {model_directory() / one} can't be read ({err.strerror}); {_again(name)}"
            ) from err
        if actual != files[one]:
            raise ModelError(
                f"model {name}: {model_directory() / one}: SHA-256 is {actual}, expected {files[one]}; {_again(name)}"
            )
        hashes.append(actual)
    return StoredGraph(model_directory() / file, hashes[0] if len(hashes) == 1 else joint_sha256(*hashes))


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
