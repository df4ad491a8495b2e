"""Windows: parts of photographs at several sizes, each as costly to render as a reduced photograph.

A window is a camera with a shifted principal point, so a field renders it as any image.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera, crop_camera, pixels_to_points
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.photos.depth_maps import GatherSources, read_depths, read_pixel_depths
from jaxcloseup.photos.pyramids import Pyramid, photograph_pyramid
from jaxcloseup.photos.views import Batch, Views, camera_at, to_float


@struct.dataclass
class Windows:
    """Photographs of one capture at L sizes, V views.

    Attributes:
      cameras: stacked cameras, with the size of all windows, which fit into every photograph at
        every level.
      pyramid: `[P, 4]` colors and weights of the photographs.
      shares: `[L]` probability of each level, finest first.
      places: `[K, 3]` centers of windows, of which each is drawn alike: a view, and x and y as
        shares of its width and height; None: windows lie anywhere.
      depths: depth maps of the photographs, whose depths windows have too; None: there are none.
    """

    cameras: Camera
    pyramid: Pyramid
    shares: jax.Array
    places: jax.Array | None = None
    depths: GatherSources | None = None

    def __len__(self) -> int:
        """Return the number of photographs."""
        return len(self.pyramid)

    @property
    def size(self) -> tuple[int, int]:
        """Return height and width of a window in pixels."""
        return self.cameras.height, self.cameras.width


def photograph_windows(cameras: Camera, pyramid: Pyramid, *, whole_share: float) -> Windows:
    """Make windows of which a share is whole photographs of the coarsest level.

    If photographs differ in size, windows have the size that all have in common there. Each of the
    other levels is four times as likely as the next coarser one, because it shows more.

    Args:
      cameras: stacked cameras of the coarsest level.
      pyramid: `[P, 4]` colors and weights.
      whole_share: in [0, 1].
    """
    finer = len(pyramid.sizes) - 1
    often = [4.0**-level for level in range(finer)]
    shares = [(1 - whole_share) * times / sum(often) for times in often]
    shares = [*shares, whole_share] if finer else [1.0]
    height, width = np.asarray(pyramid.extents)[:, -1].min(axis=0).tolist()
    cameras = cameras.replace(height=height, width=width)
    return Windows(cameras, pyramid, jnp.array(shares, jnp.float32))


def view_windows(views: Views, height: int, width: int) -> Windows:
    """Make windows of larger views, at their own size and at halves, all equally likely."""
    pyramid = photograph_pyramid(views, least=(height, width))
    count = len(pyramid.sizes)
    cameras = views.cameras.replace(height=height, width=width)
    return Windows(cameras, pyramid, jnp.full(count, 1 / count, jnp.float32))


def windows_that_see(
    key: jax.Array,
    windows: Windows,
    cameras: Camera,
    depths: jax.Array,
    views: Views,
    view_depths: jax.Array,
    *,
    count: int = 4096,
    tolerance: float = 0.05,
) -> Windows:
    """Restrict windows to places around the surfaces that other cameras see; `key` is consumed.

    Outside of `jax.jit`, which would copy the photographs.

    Pixels of these cameras are drawn uniformly, and for each one of the photographs that see its
    surface; a pixel that none sees draws a place in any photograph.

    Args:
      key: random key.
      windows: the photographs.
      cameras: stacked `[Q]`.
      depths: `[Q, H, W]` their z-depths; 0 is undefined.
      views: the photographs as small as their depths, V views.
      view_depths: `[V, H, W]` z-depths of the photographs.
      count: number K of places.
      tolerance: relative difference of depths up to which a photograph sees a surface.
    """
    sizes = windows.pyramid.extents[:, -1, ::-1]
    of_cameras, of_views = (cameras, depths), (views.cameras, view_depths, views.weight)
    places = _find_places(key, of_cameras, of_views, sizes, count=count, tolerance=tolerance)
    return dataclasses.replace(windows, places=places)


@functools.partial(jax.jit, static_argnames=("count", "tolerance"))
def _find_places(
    key: jax.Array,
    of_cameras: tuple[Camera, jax.Array],
    of_views: tuple[Camera, jax.Array, jax.Array],
    sizes: jax.Array,
    *,
    count: int,
    tolerance: float,
) -> jax.Array:
    """Return `Windows.places`; `sizes` `[V, 2]` are width and height of views without padding."""
    cameras, depths = of_cameras
    key_camera, key_pixel, key_view, key_any = jax.random.split(key, 4)
    which = jax.random.randint(key_camera, (count,), 0, depths.shape[0])
    size = jnp.array([cameras.width, cameras.height], jnp.float32)
    pixels = jax.random.uniform(key_pixel, (count, 2)) * size[None]
    column, row = jnp.floor(pixels).astype(jnp.int32).T
    depth = depths[which, row, column]

    def point(camera: jax.Array, pixel: jax.Array, depth: jax.Array) -> jax.Array:
        return pixels_to_points(camera_at(cameras, camera), pixel, depth)

    points = jax.vmap(point)(which, pixels, jnp.where(depth > 0, depth, 1))

    def look(
        camera: Camera, view_depth: jax.Array, weight: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        landed, _, weight = sample_where_visible(camera, view_depth, weight, points, tolerance)
        return landed, weight

    landed, seen = jax.vmap(look)(*of_views)
    seen = jnp.where(depth[None] > 0, seen, 0)
    # Any photograph is as good as another where none sees the point.
    view = jax.random.categorical(key_view, jnp.log(seen + 1e-6), axis=0)
    chosen = view, jnp.arange(count)
    size = jnp.array([of_views[0].width, of_views[0].height], jnp.float32)
    # Views of a photograph that is smaller than others are padded.
    own = sizes.astype(jnp.float32)
    shares = landed[chosen] / size[None] * (own.max(0)[None] / own)[view]
    anywhere = jax.random.uniform(key_any, (count, 2))
    place = jnp.where(seen[chosen][:, None] > 0, shares, anywhere)
    return jnp.concatenate([view[:, None].astype(place.dtype), place], 1)


def sample_window(key: jax.Array, windows: Windows) -> Batch:
    """Draw a place, of any photograph or of those given, and a level by its share; consumes `key`.

    The window lies around the place as far as the photograph reaches.
    """
    key_view, key_level, key_y, key_x = jax.random.split(key, 4)
    level = jax.random.categorical(key_level, jnp.log(windows.shares))
    size = jnp.array(windows.size, jnp.int32)
    if windows.places is None:
        view = jax.random.randint(key_view, (), 0, len(windows))
        room = windows.pyramid.extents[view, level] - size + 1
        corner = jnp.stack(
            [jax.random.randint(key_y, (), 0, room[0]), jax.random.randint(key_x, (), 0, room[1])]
        )
    else:
        view, center = _draw_place(key_view, windows.places, ())
        room = windows.pyramid.extents[view, level] - size + 1
        extent = windows.pyramid.extents[view, level].astype(center.dtype)
        corner = jnp.floor(center * extent - size.astype(center.dtype) / 2).astype(jnp.int32)
        corner = jnp.clip(corner, 0, room - 1)
    return cut_window(windows, view, level, corner)


def _draw_place(
    key: jax.Array, places: jax.Array, shape: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Draw a view `[...]`, and y and x `[..., 2]` as shares of its height and width."""
    place = places[jax.random.randint(key, shape, 0, len(places))]
    return place[..., 0].astype(jnp.int32), place[..., :0:-1]


def sample_window_pixels(key: jax.Array, windows: Windows, count: int) -> Batch:
    """Draw `count` pixels with replacement, for fields that render single rays; consumes `key`.

    Each is one of a photograph drawn uniformly, of a level by its share, of its pixels uniformly;
    or of a window around a given place.
    """
    key_view, key_level, key_y, key_x = jax.random.split(key, 4)
    pyramid = windows.pyramid
    level = jax.random.categorical(key_level, jnp.log(windows.shares), shape=(count,))
    if windows.places is None:
        view = jax.random.randint(key_view, (count,), 0, len(windows))
        height, width = pyramid.extents[view, level].T
        y = jax.random.randint(key_y, (count,), 0, height)
        x = jax.random.randint(key_x, (count,), 0, width)
    else:
        view, center = _draw_place(key_view, windows.places, (count,))
        within = jax.random.uniform(key_y, (count, 2)) - 0.5
        extent = pyramid.extents[view, level].astype(center.dtype)
        size = jnp.array(windows.size, center.dtype)
        pixel = jnp.floor(center * extent + within * size[None]).astype(jnp.int32)
        y, x = jnp.clip(pixel, 0, pyramid.extents[view, level] - 1).T
    first, width = pyramid.starts[view, level], pyramid.extents[view, level, 1]
    values = to_float(pyramid.at_middle(pyramid.values[first + y * width + x], view))
    cameras = camera_at(windows.cameras, view)
    cameras = cameras.replace(intrinsics=pyramid.intrinsics[view, level])
    pixels = jnp.stack([x, y], axis=-1).astype(jnp.float32) + 0.5
    depths, measured = windows.depths, None
    if depths is not None:
        measured = read_pixel_depths(depths, view, cameras, pixels)
    return Batch(cameras, pixels, values[..., :3], values[..., 3], measured)


def cut_window(
    windows: Windows, view: jax.Array | int, level: jax.Array | int, corner: jax.Array
) -> Batch:
    """Cut the window of a view at a level whose first pixel is in row and column `corner[2]`."""
    pyramid = windows.pyramid
    height, width = windows.size
    start, across = pyramid.starts[view, level], pyramid.extents[view, level, 1]
    rows = corner[0] + jnp.arange(height)[:, None]
    columns = corner[1] + jnp.arange(width)[None]
    values = to_float(pyramid.at_middle(pyramid.values[start + rows * across + columns], view))
    camera = camera_at(windows.cameras, view).replace(intrinsics=pyramid.intrinsics[view, level])
    camera = crop_camera(camera, corner[::-1], height=height, width=width)
    measured = None if windows.depths is None else read_depths(windows.depths, view, camera)
    return Batch(camera, None, values[..., :3], values[..., 3], measured)


def in_quarters(render: Callable[[Camera], Any], camera: Camera) -> Any:
    """Compute `render(camera)` by four calls for a quarter of the image each.

    Args:
      render: returns arrays `[H, W, ...]` of a camera's pixels.
      camera: one camera.
    """
    height, width = -(-camera.height // 2), -(-camera.width // 2)
    corners = (0, 0), (width, 0), (0, height), (width, height)
    parts = [crop_camera(camera, jnp.array(x), height=height, width=width) for x in corners]

    def join(*images: jax.Array) -> jax.Array:
        halves = (np.concatenate(pair, axis=1) for pair in (images[:2], images[2:]))
        return jnp.asarray(np.concatenate(list(halves))[: camera.height, : camera.width])

    return jax.tree.map(join, *map(render, parts))
