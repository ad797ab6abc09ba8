"""What a camera over the generated world sees: perspective, occlusion, façades, and the flaws of a sensor.

No GPU: every pixel's ray is marched against the height field, first over grids of local maxima (about 8, 2 and 0.5 m),
where it may take long strides without passing through anything, then in steps of a texel until it is below the
surface, and bisected there. Between texels the surface is interpolated, so a wall leans over one texel and a roof ends
half a texel early on average (6 cm in the demo).

Coordinates inside are local map metres of the world (`layout`) in float32, which
resolves 0.1 mm there; map coordinates would be 0.5 m apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_sim.world import FIRST_CAR, FIRST_TREE, Scene, base_height

# A raster of whatever type.
AnyArray = npt.NDArray[Any]

_SKY = (198, 206, 214)
# Rays flatter than this (3 degrees below the horizon) end in haze; the world is too small for them anyway.
_FLATTEST = 0.05
_CELLS_M = (8.0, 2.0, 0.5)
_STRIDES = (14, 14, 10)
_MAX_FINE_STEPS = 400
_BISECTIONS = 6
# Whose rays are kept: a rolling shutter's strips are cameras of their own.
_MAX_CAMERAS = 32
_STOREY_M, _WINDOW_EVERY_M = 2.9, 2.6


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the world lies in the map: south-west corner, and grid metres per true metre (horizontal lengths of
    the world are grid metres, heights are true ones)."""

    west_m: float
    south_m: float
    grid_scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """Flaws of the picture.

    Attributes:
        gain: exposure.
        vignetting: share of light lost in the corners.
        noise: 1-sigma in grey values at mid grey.
        blur_px: 1-sigma of the lens.
        jpeg_quality: of the round trip through JPEG; 0 leaves it out.
    """

    gain: float = 1.0
    vignetting: float = 0.22
    noise: float = 2.5
    blur_px: float = 0.6
    jpeg_quality: int = 88

    def expose(self, clean: ImageArray, camera: Camera, seed: int) -> ImageArray:
        """What it makes of a clean picture (H, W, 3) RGB; ``seed`` picks the noise."""
        image = (
            cv2.GaussianBlur(clean, (0, 0), self.blur_px).astype(np.float32)
            if self.blur_px
            else clean.astype(np.float32)
        )
        u = (np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)) / np.float32(camera.fx)
        v = (np.arange(camera.height, dtype=np.float32) - np.float32(camera.cy)) / np.float32(camera.fy)
        r2 = u[None] ** 2 + v[:, None] ** 2
        image *= (np.float32(self.gain) * (1.0 - np.float32(self.vignetting) * r2 / r2.max()))[..., None]
        if self.noise:
            rng = np.random.default_rng([seed, 77])
            image += np.float32(self.noise) * rng.standard_normal(image.shape, dtype=np.float32)
        picture: ImageArray = np.clip(image, 0, 255).astype(np.uint8)
        if self.jpeg_quality:
            _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
            picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)
        return picture

@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A rendered picture and what is in it.

    Attributes:
        image: (H, W, 3) RGB.
        points_map: (H, W, 3) float64 map coordinates of what each pixel shows; NaN for sky.
        objects: (H, W) ids as in `Scene.objects`.
        facade: (H, W) whether the pixel shows a wall.
    """

    image: ImageArray
    points_map: FloatArray
    objects: npt.NDArray[np.uint16]
    facade: BoolArray


class Renderer:
    """Draws one scene. Not for several threads at once.

    Args:
        level_by_pixel: every pixel is drawn from texels of its own size on the ground, and not all from those of a
            typical pixel: for views with near and far ground.
    """

    def __init__(
        self, scene: Scene, placement: Placement, sensor: Sensor | None = None, *, level_by_pixel: bool = False
    ) -> None:
        self.scene, self.placement, self.sensor = scene, placement, sensor or Sensor()
        self._level_by_pixel = level_by_pixel
        gsd = scene.spec.gsd_m
        # Cells are whole texels: 0.5 m of 0.2 m texels are cells of 0.4 m.
        blocks = [max(1, round(cell / gsd)) for cell in _CELLS_M]
        self._maxima = [(_dilated_maximum(scene.surface, block), block * gsd) for block in blocks]
        self._highest = float(scene.surface.max())
        self._textures = [scene.texture]
        for _ in range(3):
            self._textures.append(np.asarray(cv2.pyrDown(self._textures[-1]), dtype=np.uint8))
        houses = scene.buildings
        self._houses = np.array(
            [
                (
                    h.x_m, h.y_m, np.cos(h.angle_rad), np.sin(h.angle_rad), h.length_m, h.width_m,
                    base_height(scene.spec, scene.terrain, h), h.eave_m, *h.wall,
                )
                for h in houses
            ],
            dtype=np.float32,
        ).reshape(-1, 11)  # fmt: skip
        self._rays: dict[Camera, Float32Array] = {}

    def render(self, camera: Camera, map_from_camera: Rigid3, seed: int = 0) -> ImageArray:
        """(H, W, 3) RGB picture; ``seed`` picks its noise."""
        return self.sensor.expose(self.clean(camera, map_from_camera), camera, seed)

    def clean(self, camera: Camera, map_from_camera: Rigid3) -> ImageArray:
        """(H, W, 3) RGB, without the sensor's flaws."""
        return self._trace(camera, map_from_camera)[0]

    def view(self, camera: Camera, map_from_camera: Rigid3, seed: int = 0) -> View:
        """The picture together with its geometry."""
        clean, x, y, z, objects, facade = self._trace(camera, map_from_camera)
        shape = (camera.height, camera.width)
        local = np.stack([x, y, z], axis=-1).astype(np.float64).reshape(*shape, 3)
        points = local + np.array([self.placement.west_m, self.placement.south_m, 0.0])
        return View(self.sensor.expose(clean, camera, seed), points, objects.reshape(shape), facade.reshape(shape))

    def _directions(self, camera: Camera) -> Float32Array:
        if camera not in self._rays:
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2))
            if len(self._rays) >= _MAX_CAMERAS:
                self._rays.clear()
            self._rays[camera] = rays.astype(np.float32)
        return self._rays[camera]

    def _trace(
        self, camera: Camera, map_from_camera: Rigid3
    ) -> tuple[ImageArray, Float32Array, Float32Array, Float32Array, npt.NDArray[np.uint16], BoolArray]:
        """Colours before the sensor (H, W, 3), and flat x, y, z (local m), object ids and façade flags."""
        place, scene = self.placement, self.scene
        eye = map_from_camera.translation - (place.west_m, place.south_m, 0.0)
        directions = self._directions(camera) @ map_from_camera.rotation.T.astype(np.float32)
        down = -directions[:, 2]
        seen = np.flatnonzero(down > _FLATTEST * np.linalg.norm(directions, axis=1))
        everything = len(seen) == len(down)
        if not everything:
            directions, down = directions[seen], down[seen]
        # Grid metres travelled per metre of descent.
        a = directions[:, 0] / down * np.float32(place.grid_scale)
        b = directions[:, 1] / down * np.float32(place.grid_scale)
        ray = _Rays(np.float32(eye[0]), np.float32(eye[1]), float(eye[2]), a, b)
        descent, before = self._intersect(ray)
        x, y = ray.xy(descent)
        z = (ray.height - descent).astype(np.float32)
        # A touch into the thing that stopped the ray: on a wall, the house behind it.
        nudge = np.float32(0.10) / np.maximum(np.hypot(a, b), 1e-3)
        ids = self._nearest(scene.objects, x + a * nudge, y + b * nudge)
        top = self._nearest(scene.surface, x + a * nudge, y + b * nudge)
        low = self._nearest(scene.surface, *ray.xy(np.minimum(before, descent)))
        wall = (ids > 0) & (ids < FIRST_TREE) & (top - z > 0.25) & (top - low > 0.8)
        if self._level_by_pixel:
            colours = self._textured_by_pixel(self._levels(descent * np.sqrt(1.0 + a * a + b * b), camera), x, y)
        else:
            colours = self._textured(int(self._levels(np.asarray(np.median(descent)), camera)), x, y)
        self._paint_walls(colours, wall, ids, x, y, z)
        crown = (ids >= FIRST_TREE) & (ids < FIRST_CAR)
        depth = np.clip(1.0 - 0.10 * (top - z), 0.55, 1.0)
        shaded = np.flatnonzero(crown & (depth < 0.97))
        colours[shaded] = (colours[shaded] * depth[shaded, None]).astype(np.uint8)
        if not everything:
            n = camera.width * camera.height
            full = np.full((n, 3), _SKY, dtype=np.uint8)
            full[seen] = colours
            out: list[AnyArray] = []
            for values, fill in ((x, np.nan), (y, np.nan), (z, np.nan), (ids, 0), (wall, False)):
                spread = np.full(n, fill, dtype=values.dtype)
                spread[seen] = values
                out.append(spread)
            colours = full
            x, y, z, ids, wall = out
        return colours.reshape(camera.height, camera.width, 3), x, y, z, ids, wall

    def _intersect(self, ray: _Rays) -> tuple[Float32Array, Float32Array]:
        """Descent in m from the eye to the first hit of every ray, and one a little before it."""
        slope = np.maximum(np.hypot(ray.a, ray.b), np.float32(1e-3))
        descent = np.full(len(slope), max(0.0, ray.height - self._highest - 0.1), dtype=np.float32)
        for (maxima, cell), strides in zip(self._maxima, _STRIDES, strict=True):
            reach = np.float32(0.98 * cell) / slope
            for _ in range(strides):
                x, y = ray.xy(descent)
                # Nothing within a cell's width stands higher than this.
                clear = np.float32(ray.height) - descent - self._nearest(maxima, x, y, cell)
                stride = np.minimum(np.maximum(clear - np.float32(0.02), 0.0), reach)
                descent += stride
                if float(stride.max()) < 0.05:
                    break
        gsd = self.scene.spec.gsd_m
        step = np.minimum(np.float32(gsd) / slope, np.float32(0.35))
        active = np.arange(len(slope))
        a, b, at, step_active = ray.a, ray.b, descent.copy(), step
        for _ in range(_MAX_FINE_STEPS):
            surface = self._bilinear(self.scene.surface, ray.x + a * at, ray.y + b * at)
            above = np.float32(ray.height) - at > surface
            descent[active] = at
            if not above.any():
                break
            active, a, b, step_active = active[above], a[above], b[above], step_active[above]
            at = at[above] + step_active
        low = np.maximum(descent - step, 0.0)
        start = low
        high = descent
        for _ in range(_BISECTIONS):
            middle = (low + high) * np.float32(0.5)
            x, y = ray.xy(middle)
            above = np.float32(ray.height) - middle > self._bilinear(self.scene.surface, x, y)
            low = np.where(above, middle, low)
            high = np.where(above, high, middle)
        return high, start - step

    def _pixels(self, x: Float32Array, y: Float32Array, gsd: float) -> tuple[Float32Array, Float32Array]:
        u = x * np.float32(1.0 / gsd) - np.float32(0.5)
        v = (np.float32(self.scene.spec.height_m) - y) * np.float32(1.0 / gsd) - np.float32(0.5)
        return u, v

    def _nearest(self, raster: AnyArray, x: Float32Array, y: Float32Array, gsd: float | None = None) -> AnyArray:
        u, v = self._pixels(x, y, gsd or self.scene.spec.gsd_m)
        return _remapped(raster, u, v, cv2.INTER_NEAREST)

    def _bilinear(self, raster: AnyArray, x: Float32Array, y: Float32Array) -> AnyArray:
        return _remapped(raster, *self._pixels(x, y, self.scene.spec.gsd_m), cv2.INTER_LINEAR)

    def _levels(self, distance_m: AnyArray, camera: Camera) -> AnyArray:
        """Of the textures, for what is so far away."""
        texels = np.maximum(1e-6, distance_m.astype(np.float64) / camera.focal_px / self.scene.spec.gsd_m)
        return np.clip(np.floor(np.log2(texels) + 0.2), 0, len(self._textures) - 1).astype(np.intp)

    def _textured_by_pixel(self, levels: AnyArray, x: Float32Array, y: Float32Array) -> ImageArray:
        colours = np.empty((len(x), 3), dtype=np.uint8)
        for level in np.unique(levels):
            at = np.flatnonzero(levels == level)
            colours[at] = self._textured(int(level), x[at], y[at])
        return colours

    def _textured(self, level: int, x: Float32Array, y: Float32Array) -> ImageArray:
        u, v = self._pixels(x, y, self.scene.spec.gsd_m)
        # pyrDown keeps pixel (2i, 2j) as (i, j): a scale about the first pixel's centre.
        scale = np.float32(0.5**level)
        return np.asarray(_remapped(self._textures[level], u * scale, v * scale, cv2.INTER_LINEAR), dtype=np.uint8)

    def _paint_walls(
        self,
        colours: ImageArray,
        wall: BoolArray,
        ids: npt.NDArray[np.uint16],
        x: Float32Array,
        y: Float32Array,
        z: Float32Array,
    ) -> None:
        at = np.flatnonzero(wall)
        if len(at) == 0:
            return
        house = self._houses[ids[at].astype(np.intp) - 1]
        cx, cy, c, s, length, width, base, eave = house[:, :8].T
        dx, dy = x[at] - cx, y[at] - cy
        along, across = c * dx + s * dy, -s * dx + c * dy
        end = np.abs(along) / length > np.abs(across) / width
        sign = np.where(end, np.sign(along), np.sign(across))
        normal_x = np.where(end, c, -s) * sign
        normal_y = np.where(end, s, c) * sign
        u, v = np.where(end, across, along), z[at] - base
        window = (np.mod(u, _WINDOW_EVERY_M) > 0.8) & (np.mod(u, _WINDOW_EVERY_M) < 1.9)
        window &= (np.mod(v, _STOREY_M) > 0.9) & (np.mod(v, _STOREY_M) < 2.1) & (v < eave - 0.3)
        sun = self.scene.epoch.sun
        lit = np.clip(normal_x * sun[0] + normal_y * sun[1], 0.0, 1.0) / sun[2]
        ambient, direct = np.array(self.scene.epoch.ambient), np.array(self.scene.epoch.direct)
        light = 0.9 * ambient + np.clip(lit, 0.0, 1.1)[:, None] * direct
        paint = np.where(window[:, None], np.array([52, 60, 72], dtype=np.float32), house[:, 8:11])
        colours[at] = np.clip(paint * light, 0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Rays from (x, y, height), local m; ``a`` and ``b`` are metres east and north per metre of descent."""

    x: np.float32
    y: np.float32
    height: float
    a: Float32Array
    b: Float32Array

    def xy(self, descent: Float32Array) -> tuple[Float32Array, Float32Array]:
        return self.x + self.a * descent, self.y + self.b * descent


def _dilated_maximum(surface: Float32Array, block: int) -> Float32Array:
    """Maximum of each block of ``block`` x ``block`` pixels and its eight neighbours."""
    rows, columns = surface.shape
    padded = np.pad(surface, ((0, -rows % block), (0, -columns % block)), mode="edge")
    maxima = padded.reshape(padded.shape[0] // block, block, -1, block).max(axis=(1, 3))
    return np.asarray(cv2.dilate(maxima, np.ones((3, 3), np.uint8)), dtype=np.float32)


def _remapped(raster: AnyArray, u: Float32Array, v: Float32Array, how: int) -> AnyArray:
    """Values at pixels (N,); beyond the raster its edge goes on. cv2 wants pictures: N is folded to rows."""
    n, row = len(u), 4096
    rows = -(-n // row)
    folded_u, folded_v = np.zeros((rows, row), np.float32), np.zeros((rows, row), np.float32)
    folded_u.ravel()[:n], folded_v.ravel()[:n] = u, v
    values = cv2.remap(raster, folded_u, folded_v, how, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.reshape(rows * row, *raster.shape[2:])[:n])
