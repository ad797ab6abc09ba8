"""XFeat with mutual nearest neighbours: the network on ONNX Runtime, everything around it in numpy and OpenCV."""

from __future__ import annotations

import copy
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.nearest import mutual_nearest
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import WorkingImage, check_numbers, reduced_size, working_image

_INPUT: Final = "normalised"
_OUTPUTS: Final = ["features", "heat", "reliability"]
MULTIPLE_PX: Final = 32  # the coarsest level of the network is at 1/32
CELL_PX: Final = 8
DESCRIPTOR: Final = 64

# The published detector's: heat threshold 0.05, non-maximum suppression over 5 x 5 (modules/xfeat.py).
_MIN_HEAT: Final = 0.05
_SUPPRESSION: Final = np.ones((5, 5), np.uint8)
_NORMALISATION_EPSILON: Final = 1e-5  # added to the variance, in grey levels squared
# torch's bicubic kernel, with which the published descriptors are sampled; OpenCV's is the same, but its
# remap takes 4 channels and 1/32 px.
_BICUBIC_A: Final = -0.75


class XFeatNetwork:
    """The graph of `models.XFEAT` in a session of its own.

    Args:
        graph: ONNX bytes.
        sha256: that they must have.
        threads: of one inference. Two one-thread sessions on two images beat one with two threads.
    Raises: ModelError if the hash differs or the runtime does not take the graph.
    """

    def __init__(self, graph: bytes, sha256: str, threads: int) -> None:
        self._inference = Inference(
            graph, sha256, threads, what="XFeat", model="xfeat", inputs=[_INPUT], outputs=_OUTPUTS
        )

    def run(self, grey: ImageArray, usable: BoolArray | None = None) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Features (1, 64, H/8, W/8), heat (1, 1, H, W), reliability (1, 1, H/8, W/8) of ``grey``
        (H, W), normalised over ``usable`` (H, W) or all of it.

        Raises: ModelError if the runtime fails.
        """
        features, heat, reliability = self._inference.run(
            {_INPUT: normalised(grey, usable)[None, None]}, f"{grey.shape[1]} x {grey.shape[0]} px"
        )
        return features, heat, reliability


class XFeatMatcher:
    """Sparse XFeat. Keeps no state between calls, so one object may serve several threads.

    Args:
        model_bytes: the ONNX graph.
        sha256: that it must have.
        working_px: long side that images are brought to, a multiple of 32. Both sides are rounded to
            multiples of 32, so the aspect changes by a few per cent and the two axes are scaled back apart.
        max_keypoints: kept per image, best first.
        min_cosine: of two descriptors to match; 0.82 is the published matcher's default.
        threads: of one inference. NumPy's BLAS has its own, OPENBLAS_NUM_THREADS=1 is best for :meth:`match`.
    Raises: ModelError if the graph's hash differs or it can't be loaded; ValueError for an unusable number.
    """

    def __init__(
        self,
        model_bytes: bytes,
        sha256: str,
        *,
        working_px: int = 640,
        max_keypoints: int = 2048,
        min_cosine: float = 0.82,
        threads: int = 1,
    ) -> None:
        check_numbers("XFeat", MULTIPLE_PX, 2 * MULTIPLE_PX, working_px, max_keypoints, threads)
        self.name = "xfeat"
        self.model_sha256: str | None = sha256.lower()
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._min_cosine = min_cosine
        self._network = XFeatNetwork(model_bytes, sha256, threads)

    def reduced(self, scale: float) -> XFeatMatcher:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale, MULTIPLE_PX)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey; none within 8 working pixels of where ``valid`` is False.

        An image that is tiny, constant or invalid throughout has no features, which is no error.
        Raises: ModelError if the inference fails; ValueError if image or mask have another type or shape.
        """
        width, height = working_size(image.shape, self.working_px)
        return self._extracted(working_image(image, valid, width, height))

    def extract_unscaled(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """As `extract`, at the image's own size: one pixel of it is one of the network's.

        For pictures that are already at the scale of what they are matched with.
        """
        rows, columns = image.shape
        below, right = -rows % MULTIPLE_PX, -columns % MULTIPLE_PX
        if below or right:
            known = np.ones(image.shape, np.bool_) if valid is None else valid
            valid = np.pad(known, ((0, below), (0, right)))
            image = np.pad(image, ((0, below), (0, right)))
        return self._extracted(working_image(image, valid, columns + right, rows + below))

    def _extracted(self, work: WorkingImage | None) -> Features:
        if work is None:
            return Features.none(DESCRIPTOR)
        features, heat, reliability = self._network.run(work.image, work.usable)
        pixels, scores = _keypoints(heat[0, 0], reliability[0, 0], work.usable, self._max_keypoints)
        # Rows of channels, so that a cell's 64 numbers lie together.
        cells = np.ascontiguousarray(features[0].transpose(1, 2, 0))
        return Features(work.original_px(pixels), scores, _descriptors(cells, pixels))

    def match(self, query: Features, reference: Features) -> Matches:
        """Mutual nearest neighbours of cosine ``min_cosine`` or more.

        ``confidence`` is None: a cosine of descriptors ranks pairs of one image, but it is no probability of
        being right, and what it means shifts with season and spectrum. Whoever wants one must calibrate it.
        """
        i, j = mutual_nearest(query.descriptors, reference.descriptors, self._min_cosine)
        return Matches(query.keypoints_px[i], reference.keypoints_px[j])


def normalised(grey: ImageArray, usable: BoolArray | None) -> Float32Array:
    """``grey`` with mean 0 and variance 1 over ``usable``.

    The published network does this inside, over the whole image. With holes that is wrong: a flat half takes
    half of the variance away, which raises the contrast of the rest. Four recorded photos under a known
    homography, the right half of one image invalid: of 1419, 1574, 1644 and 1423 right matches in the left
    half 611, 1353, 1521 and 1198 were left, and 825, 1443, 1593 and 1373 with the holes out of the
    statistics. (They are still filled: zeroing the margin, too, lost some of these again.)
    """
    values = grey if usable is None else grey[usable]
    mean = float(values.mean(dtype=np.float64))
    deviation = float(np.sqrt(values.var(dtype=np.float64) + _NORMALISATION_EPSILON))
    # 256 grey levels: a table is faster than arithmetic on each pixel.
    table = ((np.arange(256) - mean) / deviation).astype(np.float32)
    return np.asarray(cv2.LUT(grey, table), dtype=np.float32)


def working_size(shape: tuple[int, ...], working_px: int, multiple_px: int = MULTIPLE_PX) -> tuple[int, int]:
    """(width, height), multiples of ``multiple_px``, nearest to the aspect of ``shape`` (rows, columns)."""
    rows, columns = shape[:2]
    longest = max(rows, columns, 1)

    def side(pixels: int) -> int:
        return max(multiple_px, round(pixels * working_px / longest / multiple_px) * multiple_px)

    return side(columns), side(rows)


def _keypoints(
    heat: Float32Array, reliability: Float32Array, usable: BoolArray | None, limit: int
) -> tuple[FloatArray, Float32Array]:
    """Local maxima (N, 2) in working pixels and their scores, best first."""
    is_peak = (heat > _MIN_HEAT) & (heat == cv2.dilate(heat, _SUPPRESSION))
    if usable is not None:
        is_peak &= usable
    v, u = np.nonzero(is_peak)
    pixels = np.stack([u, v], axis=1).astype(np.float64)
    scores: Float32Array = heat[v, u] * _sample_linear(reliability, pixels)
    # Stable, so that ties keep row order on every machine.
    order = np.argsort(-scores, kind="stable")[:limit]
    return pixels[order] + _subpixel(heat, v[order], u[order]), scores[order]


def _subpixel(heat: Float32Array, v: IntArray, u: IntArray) -> FloatArray:
    """Offsets (N, 2) of peaks from their pixels, -0.5..0.5: the vertex of a parabola through log heat, per axis.

    Not in the published detector. On the four recorded query photos under a known homography it takes the
    median error from 1.21 to 0.93 px at 1024 px, working at 640; a parabola through the heat itself gives 1.01.
    """
    return parabola_offsets(np.log(np.maximum(heat, np.float32(1e-6))), v, u)


def parabola_offsets(values: Float32Array, v: IntArray, u: IntArray) -> FloatArray:
    """Offsets (N, 2), (u, v), of local maxima at (v, u) of ``values`` (H, W) from their pixels, -0.5..0.5: the vertex
    of a parabola per axis; 0 at the rim."""
    offsets = np.zeros((len(u), 2))
    rows, columns = values.shape
    inside = np.flatnonzero((u > 0) & (u < columns - 1) & (v > 0) & (v < rows - 1))
    v, u = v[inside], u[inside]
    centre = values[v, u]
    for axis, (before, after) in enumerate(
        (
            (values[v, u - 1], values[v, u + 1]),
            (values[v - 1, u], values[v + 1, u]),
        )
    ):
        # At a maximum the curvature is not positive; where three values are equal there is no vertex.
        curvature = before - 2 * centre + after
        offset = np.divide(before - after, 2 * curvature, out=np.zeros_like(centre), where=curvature < -1e-6)
        offsets[inside, axis] = np.clip(offset, -0.5, 0.5)
    return offsets


def _cell_position(pixels: FloatArray, axis: int) -> tuple[IntArray, Float32Array]:
    """Cell whose centre is at or before each pixel, and the fraction towards the next.

    The published code scales by W / (W - 1) here, off by up to half a pixel at the rims; this is plain geometry.
    """
    position = (pixels[:, axis] + 0.5) / CELL_PX - 0.5
    base = np.floor(position)
    return base.astype(np.intp), (position - base).astype(np.float32)


def _sample_linear(field: Float32Array, pixels: FloatArray) -> Float32Array:
    rows, columns = field.shape
    (x, fx), (y, fy) = _cell_position(pixels, 0), _cell_position(pixels, 1)
    x0, x1 = np.clip(x, 0, columns - 1), np.clip(x + 1, 0, columns - 1)
    y0, y1 = np.clip(y, 0, rows - 1), np.clip(y + 1, 0, rows - 1)
    upper = field[y0, x0] * (1 - fx) + field[y0, x1] * fx
    lower = field[y1, x0] * (1 - fx) + field[y1, x1] * fx
    return np.asarray(upper * (1 - fy) + lower * fy, dtype=np.float32)


def _bicubic_weights(fraction: Float32Array) -> Float32Array:
    """(4, N) weights of the cells at -1, 0, 1, 2 (Keys 1981)."""
    a = np.float32(_BICUBIC_A)

    def near(d: Float32Array) -> Float32Array:
        return ((a + 2) * d - (a + 3)) * d * d + 1

    def far(d: Float32Array) -> Float32Array:
        return ((a * d - 5 * a) * d + 8 * a) * d - 4 * a

    t = fraction
    return np.stack([far(t + 1), near(t), near(1 - t), far(2 - t)])


def _descriptors(cells: Float32Array, pixels: FloatArray) -> Float32Array:
    """Unit descriptors (N, 64) at ``pixels``, bicubic between the ``cells`` (rows, columns, 64).

    Beyond the rim the outermost cell is repeated (the published code takes zeros, which only shrinks what is
    normalised next).
    """
    rows, columns, channels = cells.shape
    (x, fx), (y, fy) = _cell_position(pixels, 0), _cell_position(pixels, 1)
    wx, wy = _bicubic_weights(fx), _bicubic_weights(fy)
    flat = cells.reshape(-1, channels)
    sampled = np.zeros((len(pixels), channels), np.float32)
    for j in range(4):
        row = np.clip(y + j - 1, 0, rows - 1) * columns
        for i in range(4):
            tap = flat[row + np.clip(x + i - 1, 0, columns - 1)]
            tap *= (wy[j] * wx[i])[:, None]
            sampled += tap
    length = np.sqrt(np.einsum("nc,nc->n", sampled, sampled))
    sampled /= np.maximum(length, np.float32(1e-12))[:, None]
    return sampled
