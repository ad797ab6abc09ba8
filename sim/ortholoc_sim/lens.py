"""What a drone's camera makes of a clean picture: blur, vignetting, exposure, tone curve, white balance, noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera

_MID_GREY = 112.0
LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Exposure:
    """A camera with the settings of one photo.

    Attributes:
        gain: exposure, on the values of the picture.
        metering: how far the camera brings a picture's mean to mid grey by itself: 0 not at all, 1 all the way.
        white: white balance, factors of red, green, blue.
        gamma: of the tone curve; above 1 darkens the middle tones.
        contrast: about mid grey.
        saturation: 0 is grey, 1 leaves colours alone.
        vignetting: share of light lost in the corners.
        noise, shot: 1 sigma in grey values in the dark, and what it grows by toward white.
        blur_px: 1 sigma of the lens.
        motion_px, motion_rad: length and direction (from +u toward +v) of the smear.
        jpeg_quality: for whoever writes the file.
    """

    gain: float
    metering: float
    white: tuple[float, float, float]
    gamma: float
    contrast: float
    saturation: float
    vignetting: float
    noise: float
    shot: float
    blur_px: float
    motion_px: float
    motion_rad: float
    jpeg_quality: int

    @classmethod
    def drawn(cls, camera: np.random.Generator, shot: np.random.Generator, mild: bool) -> Exposure:
        """By lot: ``camera`` decides what all photos of a camera share, ``shot`` what is of one photo.

        Args:
            mild: the camera renders colours and tones as the map does; only exposure and flaws vary.
        """
        spread = 0.0 if mild else 1.0
        white = 1.0 + spread * camera.normal(0.0, (0.06, 0.02, 0.08))
        gamma = float(np.exp(spread * camera.normal(0.0, 0.14)))
        contrast, saturation = 1.0 + spread * camera.normal((-0.02, -0.08), (0.08, 0.12))
        vignetting = float(camera.uniform(0.05, 0.28))
        gain = float(np.exp(shot.normal(0.0, 0.05 if mild else 0.10)))
        white = white * (1.0 + spread * shot.normal(0.0, 0.015, 3))
        return cls(
            gain,
            0.0 if mild else float(camera.uniform(0.5, 0.9)),
            (float(white[0]), float(white[1]), float(white[2])),
            gamma,
            float(contrast),
            float(saturation),
            vignetting,
            noise=float(shot.uniform(1.0, 2.5)),
            shot=float(shot.uniform(1.0, 3.0)),
            blur_px=float(shot.uniform(0.45, 0.8)),
            motion_px=float(shot.gamma(1.5, 0.5)),
            motion_rad=float(shot.uniform(0.0, np.pi)),
            jpeg_quality=int(shot.integers(80, 95)),
        )

    def expose(self, clean: ImageArray, camera: Camera, rng: np.random.Generator) -> ImageArray:
        """(H, W, 3) RGB uint8 of a clean picture (H, W, 3) RGB uint8; ``rng`` draws the noise."""
        image = cv2.GaussianBlur(clean, (0, 0), self.blur_px).astype(np.float32)
        along = np.linspace(-0.5, 0.5, 41) * self.motion_px
        smear = smear_kernel(np.column_stack([along * np.cos(self.motion_rad), along * np.sin(self.motion_rad)]))
        image = np.asarray(cv2.filter2D(image, -1, smear), dtype=np.float32)
        u = (np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)) / np.float32(camera.fx)
        v = (np.arange(camera.height, dtype=np.float32) - np.float32(camera.cy)) / np.float32(camera.fy)
        r2 = u[None] ** 2 + v[:, None] ** 2
        gain = self.gain * (_MID_GREY / max(1.0, float(image.mean()))) ** self.metering
        light = np.float32(gain / 255.0) * (1.0 - np.float32(self.vignetting) * r2 / r2.max())
        image *= light[..., None] * np.array(self.white, dtype=np.float32)
        np.clip(image, 0.0, 1.0, out=image)
        if self.gamma != 1.0:
            image = np.asarray(cv2.pow(image, self.gamma), dtype=np.float32)
        image -= np.float32(0.5)
        image *= np.float32(self.contrast)
        image += np.float32(0.5)
        grey = (image @ LUMA)[..., None]
        image = np.asarray(grey + (image - grey) * np.float32(self.saturation), dtype=np.float32)
        image *= np.float32(255.0)
        sigma = np.float32(self.noise) + np.float32(self.shot) * np.sqrt(np.clip(grey, 0.0, 1.0))
        image += sigma * rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)


def smear_kernel(offsets_px: FloatArray) -> Float32Array:
    """(K, K) what a filter takes for a motion during the exposure through ``offsets_px`` (N, 2), sampled finely."""
    reach = int(np.ceil(np.linalg.norm(offsets_px, axis=1).max())) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    for offset in offsets_px:
        u, v = reach + offset
        left, top = int(np.floor(u)), int(np.floor(v))
        a, b = u - left, v - top
        kernel[top : top + 2, left : left + 2] += np.array([[(1 - a) * (1 - b), a * (1 - b)], [(1 - a) * b, a * b]])
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
