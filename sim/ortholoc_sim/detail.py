"""What a place's rasters are too coarse for, added on a photo's own pixels: grain of the ground, crowns in the round.

A height field carries one colour per column, so a crown seen from the side is streaked; here noise in three
dimensions breaks the streaks up, and noise finer than the texels gives a low photo something to show. Both are tied
to places, so that two photos of one spot agree.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_sim.camera import View
from ortholoc_sim.noise import blobs
from ortholoc_sim.world import FIRST_CAR, FIRST_TREE

_BANK = 1024
# Texels of the bank per feature of its noise.
_FEATURE_PX = 2.0
# Feature m, 1 sigma as a share of the colour.
_GROUND = ((0.10, 0.05), (0.24, 0.05))
_ROOFS = ((0.12, 0.025), (0.30, 0.02))
_CROWNS = ((0.28, 0.16), (0.75, 0.13))
# Twigs show more contrast than leaves.
_BARE_CROWNS = ((0.22, 0.30), (0.60, 0.16))
# Directions (east, north per metre of height) along which noise slides: two of them, so no view looks along both.
_SLIDES = ((0.71, -0.53), (-0.47, 0.83))


class Detail:
    """Noise of a seed. Not for several threads at once.

    Args:
        bare: whether the trees that shed leaves have none.
    """

    def __init__(self, seed: int, bare: bool) -> None:
        noise = blobs((_BANK, _BANK), _FEATURE_PX, seed + 130)
        self._bank = np.asarray(noise / noise.std(), dtype=np.float32)
        self._crowns = _BARE_CROWNS if bare else _CROWNS

    def added(self, view: View, origin_m: FloatArray, gsd_m: float) -> ImageArray:
        """The view's picture (H, W, 3) with detail.

        Args:
            origin_m: (2,) a corner near the view, so that float32 resolves its positions.
            gsd_m: size of a pixel on the ground; noise below it would only flicker, and is left out.
        """
        # The sky has no place, and no detail.
        sky = np.isnan(view.points_map[..., 2])
        points = np.where(sky[..., None], 0.0, view.points_map - (origin_m[0], origin_m[1], 0.0))
        x, y, z = (np.asarray(points[..., k], dtype=np.float32) for k in range(3))
        crown = (view.objects >= FIRST_TREE) & (view.objects < FIRST_CAR)
        factor = np.ones(x.shape, dtype=np.float32)
        flat = np.zeros_like(z)
        ground, roof = (view.objects == 0) & ~sky, (view.objects > 0) & (view.objects < FIRST_TREE) & ~view.facade
        for mask, octaves, height, slides in (
            (ground, _GROUND, flat, _SLIDES[:1]), (roof, _ROOFS, flat, _SLIDES[:1]), (crown, self._crowns, z, _SLIDES)
        ):  # fmt: skip
            for feature_m, sigma in octaves:
                # Whole at a pixel of the feature's size, gone at twice that.
                weight = float(np.clip(2.0 - gsd_m / feature_m, 0.0, 1.0)) * sigma / np.sqrt(len(slides))
                for east, north in slides:
                    if weight > 0.0:
                        self._add(factor, mask, weight, (x + east * height, y + north * height), feature_m)
        shaded = view.image * np.clip(factor, 0.3, 1.7)[..., None]
        return np.asarray(np.clip(shaded, 0, 255), dtype=np.uint8)

    def _add(
        self,
        factor: Float32Array,
        mask: BoolArray,
        weight: float,
        where_m: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
        feature_m: float,
    ) -> None:
        # Turned against the axes, or the repetition of the bank would lie along the map's.
        scale = np.float32(_FEATURE_PX / feature_m)
        u = np.mod((where_m[0] * np.float32(0.8) + where_m[1] * np.float32(0.6)) * scale, np.float32(_BANK))
        v = np.mod((where_m[1] * np.float32(0.8) - where_m[0] * np.float32(0.6)) * scale, np.float32(_BANK))
        noise = cv2.remap(self._bank, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        factor += np.where(mask, np.float32(weight) * noise, np.float32(0.0))
