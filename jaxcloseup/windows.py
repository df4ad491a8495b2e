"""Windows: parts of photographs at several sizes, each as costly to render as a reduced photograph.

A window is a camera with a shifted principal point, so a field renders it as any image.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photographs import Batch, camera_at, to_float
from jaxcloseup.pyramids import Pyramid


@struct.dataclass
class Windows:
    """Photographs of one capture at L sizes, V views.

    Attributes:
      cameras: stacked cameras of the coarsest level, whose size all windows have.
      pyramid: `[V, P, 4]` colors and weights of the photographs.
      shares: `[L]` probability of each level, finest first.
    """

    cameras: Camera
    pyramid: Pyramid
    shares: jax.Array

    def __len__(self) -> int:
        """Number of photographs."""
        return self.pyramid.values.shape[0]


def photograph_windows(cameras: Camera, pyramid: Pyramid, *, whole_share: float) -> Windows:
    """Windows of which a share is whole photographs of the coarsest level; other levels are alike.

    Args:
      cameras: stacked cameras of the coarsest level.
      pyramid: `[V, P, 4]` colors and weights.
      whole_share: in [0, 1].
    """
    finer = len(pyramid.sizes) - 1
    shares = [(1 - whole_share) / finer] * finer + [whole_share] if finer else [1.0]
    return Windows(cameras, pyramid, jnp.array(shares, jnp.float32))


def sample_window(key: jax.Array, windows: Windows) -> Batch:
    """Draw a photograph uniformly, a level by its share, and a place uniformly; consumes `key`."""
    key_view, key_level, key_y, key_x = jax.random.split(key, 4)
    view = jax.random.randint(key_view, (), 0, len(windows))
    level = jax.random.categorical(key_level, jnp.log(windows.shares))
    sizes = jnp.asarray(windows.pyramid.sizes, jnp.int32)
    room = sizes[level] - sizes[-1] + 1
    corner = jnp.stack(
        [jax.random.randint(key_y, (), 0, room[0]), jax.random.randint(key_x, (), 0, room[1])]
    )
    return cut_window(windows, view, level, corner)


def sample_window_pixels(key: jax.Array, windows: Windows, count: int) -> Batch:
    """Draw `count` pixels with replacement, for fields that render single rays; consumes `key`.

    Each is one of a photograph drawn uniformly, of a level by its share, of its pixels uniformly.
    """
    key_view, key_level, key_y, key_x = jax.random.split(key, 4)
    pyramid = windows.pyramid
    view = jax.random.randint(key_view, (count,), 0, len(windows))
    level = jax.random.categorical(key_level, jnp.log(windows.shares), shape=(count,))
    sizes, starts = (jnp.asarray(x, jnp.int32) for x in (pyramid.sizes, pyramid.starts))
    height, width = sizes[level].T
    y = jax.random.randint(key_y, (count,), 0, height)
    x = jax.random.randint(key_x, (count,), 0, width)
    values = to_float(pyramid.values[view, starts[level] + y * width + x])
    return Batch(
        cameras=camera_at(windows.cameras, view).replace(
            intrinsics=pyramid.intrinsics[view, level]
        ),
        pixels=jnp.stack([x, y], axis=-1).astype(jnp.float32) + 0.5,
        rgb=values[..., :3],
        weight=values[..., 3],
    )


def cut_window(
    windows: Windows, view: jax.Array | int, level: jax.Array | int, corner: jax.Array
) -> Batch:
    """The window of one view at one level whose first pixel is in row and column `corner[2]`."""
    pyramid = windows.pyramid
    height, width = pyramid.sizes[-1]
    sizes, starts = (jnp.asarray(x, jnp.int32) for x in (pyramid.sizes, pyramid.starts))
    rows = corner[0] + jnp.arange(height)[:, None]
    columns = corner[1] + jnp.arange(width)[None]
    values = to_float(pyramid.values[view, starts[level] + rows * sizes[level, 1] + columns])
    moved = jnp.concatenate([jnp.zeros(2), corner[::-1].astype(jnp.float32)])
    camera = camera_at(windows.cameras, view).replace(
        intrinsics=pyramid.intrinsics[view, level] - moved, height=height, width=width
    )
    return Batch(camera, None, values[..., :3], values[..., 3])
