"""Residuals of a trained state: photographs, at several sizes, minus renders of their views."""

from collections.abc import Sequence

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.training.steps import TrainState


# How many times finer than reduced photographs a state is rendered; for finer ones it is enlarged.
FINER = 4
FINER_RAYS = 1  # the same for fields that render single rays, and so whole images slowly
MISFIT = 4  # times the median error at which a photograph has a quarter of its trust
COLOR_RIDGE = 0.01  # resistance to a photograph's change of colors, see `fit_colors`


def render_residuals(
    programs: Programs,
    state: TrainState,
    pyramid: Pyramid,
    views: Sequence[int] | None = None,
) -> tuple[Pyramid, jax.Array]:
    """Render photographs' own views, and subtract them from the photographs at every level.

    The state is rendered at levels up to `FINER` (or `FINER_RAYS`) times the reduced photographs'
    size, and enlarged for finer ones. Exposure is not detail: an affine map first brings each
    photograph's colors to its render's.

    Args:
      programs: the run's.
      state: the state to render.
      pyramid: photographs with their weights.
      views: the photographs; all by default.

    Returns:
      What these V photographs show, int8 `[V, P, 6]`, see `Detail`, and the depths `[V, H, W]` at
      their training size.
    """
    scene = programs.scene
    cameras, last = scene.train.cameras, len(pyramid.sizes) - 1
    most = FINER_RAYS if programs.method.renders_pixels else FINER
    rendered = pyramid.level_near(most * cameras.width)
    views = range(len(scene.train)) if views is None else views
    values = np.empty((len(views), pyramid.values.shape[1], 6), np.int8)

    def compare(view):
        """What is shown at each level, the coarsest first, and the depth at the coarsest."""
        found = []
        for level in range(last, -1, -1):
            camera = pyramid.camera(camera_at(cameras, view), view, level)
            photograph = pyramid.image(view, level)
            if level >= rendered:
                seen = programs.render(state, camera)
                rgb, shown_by = seen.rgb, camera
            else:
                rgb, shown_by = _enlarge(rgb, shown_by, camera), camera
            if level == last:
                # The size that the model learned from shows the exposure.
                colors = _match(photograph, seen.rgb, seen.alpha)
                depth = label_depth(seen, near=scene.near, far=scene.far)
            found.append((level, np.asarray(_subtract(photograph, rgb, colors))))
        return found, depth

    depths = []
    compared = progress.each(compare, views, "residuals of photographs")
    for own, (found, depth) in zip(values, compared, strict=True):
        depths.append(depth)
        for level, both in found:
            own[pyramid.pixels_of(level)] = both.reshape(-1, 6)
    found = Pyramid(jnp.asarray(values), pyramid.intrinsics[np.asarray(views)], pyramid.sizes)
    return found, jnp.stack(depths)


def _enlarge(rgb, camera, finer):
    """Colors of a render as a camera with the same pose and finer pixels shows them."""
    (fx, fy, cx, cy), (gx, gy, dx, dy) = map(np.asarray, (camera.intrinsics, finer.intrinsics))
    x = (np.arange(finer.width) + 0.5 - dx) / gx * fx + cx - 0.5
    y = (np.arange(finer.height) + 0.5 - dy) / gy * fy + cy - 0.5
    where = [axis.astype(np.float32) for axis in np.meshgrid(x, y)]
    return cv2.remap(np.asarray(rgb), *where, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def reproduced(shown: Pyramid) -> jax.Array:
    """How far the model reproduces each photograph at its coarsest level, `[V, H, W]` in [0, 1].

    Where it fails at the size that it learned from, its depth is not to be trusted either: a
    floater in front of one camera would else spoil every view that it sees.

    Args:
      shown: by V photographs, see `Detail`.
    """
    coarsest = shown.level(len(shown.sizes) - 1)[..., :3]
    error = np.abs(np.asarray(coarsest, np.float32)).mean(-1)
    error = np.stack([cv2.GaussianBlur(one, (0, 0), 1.5) for one in error])
    typical = max(float(np.median(error)), 1e-6)
    return jnp.asarray(1 / (1 + (error / (MISFIT * typical)) ** 4) ** 2, jnp.float32)


@jax.jit
def _match(photograph, rgb, alpha):
    """The affine change `(matrix, offset)` of a photograph's colors to those of its render.

    It is the inverse of the best change of the render, because a blurred render tells a photograph
    without bias, and a photograph a blurred render with too little contrast.
    """
    values = to_float(photograph)
    rgb = jnp.clip(rgb, 0, 1)
    # What the model lacks, or has too much, says nothing about exposure.
    error = jnp.mean(jnp.abs(values[..., :3] - rgb), axis=-1)
    typical = jnp.maximum(jnp.median(error), 1e-3)
    weight = values[..., 3] * alpha**2 / (1 + (error / (2 * typical)) ** 2) ** 2
    matrix, offset = fit_colors(rgb, values[..., :3], weight, ridge=COLOR_RIDGE)
    inverse = jnp.linalg.inv(matrix)
    change = inverse, -matmul(offset[None], inverse)[0]
    known = jnp.all(jnp.isfinite(change[0])) & jnp.all(jnp.abs(change[0]) < 2)
    same = jnp.eye(3, dtype=rgb.dtype), jnp.zeros(3, rgb.dtype)
    return jax.tree.map(lambda found, none: jnp.where(known, found, none), change, same)


@jax.jit
def _subtract(photograph, rgb, colors):
    """Residual and matched colors of a photograph, int8 `[H, W, 6]`."""
    values, (matrix, offset) = to_float(photograph), colors
    matched = change_colors(values[..., :3], matrix, offset)
    both = jnp.concatenate([matched - jnp.clip(rgb, 0, 1), 2 * matched - 1], axis=-1)
    both = jnp.where(values[..., 3:] > 0, both, 0)
    return jnp.round(127 * jnp.clip(both, -1, 1)).astype(jnp.int8)
