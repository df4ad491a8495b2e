"""Depth maps: which surfaces photographs see."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.photos.views import Measured


_SMOOTH = 0.05  # share of the inverse depth by which neighbors on a surface differ at most


@struct.dataclass
class GatherSources:
    """Depth maps that confirm what photographs see, V views.

    Attributes:
      cameras: stacked cameras of the depth maps.
      maps: `[V, H + 2, W + 2, 2]` inverse depth and trust of each pixel. Borders are repeated, so
        what lies between pixels is read without a test.
    """

    cameras: Camera
    maps: jax.Array

    @property
    def inverse_depth(self) -> jax.Array:
        """Return `[V, H, W]` 1 / z-depth, 0 where undefined."""
        return self.maps[:, 1:-1, 1:-1, 0]

    @property
    def trust(self) -> jax.Array:
        """Return `[V, H, W]` in [0, 1], 0 where a photograph or its depth does not count."""
        return self.maps[:, 1:-1, 1:-1, 1]


def join_maps(cameras: Camera, inverse_depth: jax.Array, trust: jax.Array) -> GatherSources:
    """Return depth maps `[V, H, W]` of stacked cameras, with their trust, for `gather`."""
    return GatherSources(cameras, jax.vmap(_join)(inverse_depth, trust))


def _join(inverse_depth: jax.Array, trust: jax.Array) -> jax.Array:
    maps = jnp.stack([inverse_depth, trust], axis=-1)
    return jnp.pad(maps, ((1, 1), (1, 1), (0, 0)), mode="edge")


def gather_sources(
    cameras: Camera, depths: jax.Array, weight: jax.Array, *, edge: float = 0.2
) -> GatherSources:
    """Prepare depth maps for `gather`, once for many views.

    Inverse depth is linear over a plane, so its second difference, relative to the inverse depth
    itself, shows the edges of a depth map and nothing else.

    Args:
      cameras: stacked cameras of the depth maps.
      depths: `[V, H, W]` z-depths; 0 is undefined.
      weight: `[V, H, W]` weights of the photographs in [0, 1].
      edge: relative second difference at which a pixel, and its neighbors, have 1 / 4 of their
        trust.
    """
    chex.assert_equal_shape([depths, weight])

    def prepare(of_view: tuple[jax.Array, jax.Array]) -> jax.Array:
        depth, weight = of_view
        inverse = safe_divide(jnp.ones_like(depth), depth)
        bend = jnp.zeros_like(inverse)
        for axis in (0, 1):
            size = inverse.shape[axis]
            if size > 2:
                before, here, after = (
                    jax.lax.slice_in_dim(inverse, start, start + size - 2, axis=axis)
                    for start in (0, 1, 2)
                )
                inner = tuple(slice(1, -1) if i == axis else slice(None) for i in range(2))
                bend = bend.at[inner].max(jnp.abs(before + after - 2 * here))
        trust = weight / (1 + (safe_divide(bend, inverse) / edge) ** 2) ** 2
        trust = jnp.where(depth > 0, trust, 0)
        trust = jax.lax.reduce_window(trust, jnp.inf, jax.lax.min, (3, 3), (1, 1), "SAME")
        return _join(inverse, trust)

    # One after the other: what comes between takes several times as much memory as the result.
    return GatherSources(cameras, jax.lax.map(prepare, (depths, weight)))


def read_depths(sources: GatherSources, view: jax.Array | int, camera: Camera) -> Measured:
    """Read the depth map of a view with another camera at the same place, turned alike.

    Inverse depth is interpolated, which is exact on planes; a pixel beside an edge of the depth
    map, or beside one without depth, has none.

    Args:
      sources: depth maps.
      view: which of them.
      camera: a window of its photograph, at any size.
    """
    pixels = pixel_grid(camera.height, camera.width)
    x, _ = _in_map(sources, view, camera, pixels[:1])
    _, y = _in_map(sources, view, camera, pixels[:, :1])
    return _read(sources.maps, view, x, y)


def read_pixel_depths(
    sources: GatherSources, view: jax.Array, cameras: Camera, pixels: jax.Array
) -> Measured:
    """Read the depth maps of views at single pixels, as `read_depths` reads them.

    Args:
      sources: depth maps.
      view: `[N]`, which of them.
      cameras: stacked `[N]` cameras of their photographs, at any size.
      pixels: `[N, 2]`.
    """

    def read(view: jax.Array, camera: Camera, pixel: jax.Array) -> Measured:
        return _read(sources.maps, view, *_in_map(sources, view, camera, pixel))

    return jax.vmap(read)(view, cameras, pixels)


def _in_map(
    sources: GatherSources, view: jax.Array | int, camera: Camera, pixels: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return where pixels `[..., 2]` lie in a bordered map, whose first pixel's center is 0."""
    fx, fy, cx, cy = camera.intrinsics
    gx, gy, dx, dy = sources.cameras.intrinsics[view]
    height, width = sources.maps.shape[1:3]
    x = (pixels[..., 0] - cx) / fx * gx + dx + 0.5
    y = (pixels[..., 1] - cy) / fy * gy + dy + 0.5
    return jnp.clip(x, 0, width - 1.001), jnp.clip(y, 0, height - 1.001)


def _read(maps: jax.Array, view: jax.Array | int, x: jax.Array, y: jax.Array) -> Measured:
    """Interpolate a view's bordered map at columns `x` and rows `y`, which are broadcast."""
    column, row = x.astype(jnp.int32), y.astype(jnp.int32)
    # One gather: of single pixels of many views, no map is copied.
    taps = jnp.stack([maps[view, row + j, column + i] for j in (0, 1) for i in (0, 1)])
    inverse, trust = taps[..., 0], jnp.min(taps[..., 1], axis=0)
    wx, wy = x - jnp.floor(x), y - jnp.floor(y)
    share = jnp.stack([(1 - wy) * (1 - wx), (1 - wy) * wx, wy * (1 - wx), wy * wx])
    mean = jnp.sum(share * inverse, axis=0)
    smooth = jnp.ptp(inverse, axis=0) < _SMOOTH * mean
    known = (trust > 0) & smooth
    depth = safe_divide(jnp.ones_like(mean), jnp.where(known, mean, 0))
    return Measured(depth, jnp.where(known, trust, 0))
