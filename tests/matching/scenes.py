"""Images for matchers that no file is needed for."""

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray, ImageArray


def field(width: int, height: int, seed: int = 0) -> ImageArray:
    """Ground as from above, roughly: soil in several grain sizes, parcels, and houses with sharp corners."""
    rng = np.random.default_rng(seed)
    ground = np.zeros((height, width), np.float32)
    for grain in (4, 16, 64):
        coarse = rng.normal(size=(height // grain + 2, width // grain + 2)).astype(np.float32)
        ground += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) * 9
    image = np.clip(ground + 110, 0, 255).astype(np.uint8)
    for _ in range(width * height // 4000):
        centre = (float(rng.uniform(0, width)), float(rng.uniform(0, height)))
        size = (float(rng.uniform(6, 40)), float(rng.uniform(6, 40)))
        box = cv2.boxPoints((centre, size, float(rng.uniform(0, 90))))
        cv2.fillPoly(image, [np.rint(box).astype(np.int32)], int(rng.integers(20, 235)), cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def view(width: int, height: int) -> FloatArray:
    """A homography as of a camera tilted and turned a little."""
    return np.array([[1.04, 0.07, -0.02 * width], [-0.05, 0.98, 0.03 * height], [5e-5, 6e-5, 1.0]])
