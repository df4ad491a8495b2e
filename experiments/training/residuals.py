"""Residuals of a trained state: photographs, at several sizes, minus renders of their views."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import progress
from experiments.training.programs import Programs
from jaxcloseup.label_rules import label_depth
from jaxcloseup.metrics import fit_colors
from jaxcloseup.numerics import matmul
from jaxcloseup.photographs import camera_at, to_float
from jaxcloseup.pyramids import Pyramid
from jaxcloseup.train import TrainState


# How many times finer than reduced photographs a state is rendered; for finer ones it is enlarged.
FINER = 4
FINER_RAYS = 1  # the same for fields that render single rays, and so whole images slowly
MISFIT = 4  # times the median error at which a photograph has a quarter of its trust
COLOR_RIDGE = 0.01  # resistance to a photograph's change of colors, see `fit_colors`
WINDOW = 45  # side in pixels of the windows that are kept of left-out photographs
WINDOWS = 4  # for each of them, level and imitated distance


class Window(NamedTuple):
    """A window of a left-out photograph, as the state renders it, S x S pixels.

    Attributes:
      view: its index.
      level: level of the pyramid.
      finest: the finest level that other photographs may show there.
      corner: `[2]` x, y of its first pixel.
      rgb: `[S, S, 3]` rendered colors.
      residual: `[S, S, 3]` in [-1, 1].
      weight: `[S, S]` weight of its pixels.
      depth: `[S, S]` rendered z-depth.
      alpha: `[S, S]` rendered opacity.
    """

    view: int
    level: int
    finest: int
    corner: np.ndarray
    rgb: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


def render_residuals(
    programs: Programs,
    state: TrainState,
    pyramid: Pyramid,
    left_out: Sequence[int] = (),
    views: Sequence[int] | None = None,
) -> tuple[Pyramid, list[Window], jax.Array]:
    """Render photographs' own views, and subtract them from the photographs at every level.

    The state is rendered at levels up to `FINER` (or `FINER_RAYS`) times the reduced photographs'
    size, and enlarged for finer ones. Exposure is not detail: an affine map first brings each
    photograph's colors to its render's.

    Args:
      programs: the run's.
      state: the state to render.
      pyramid: photographs with their weights.
      left_out: views of which windows are kept.
      views: the photographs; all by default.

    Returns:
      What these V photographs show, int8 `[V, P, 6]`, see `Detail`; windows of `left_out`; and the
      depths `[V, H, W]` at their training size.
    """
    scene = programs.scene
    cameras, last = scene.train.cameras, len(pyramid.sizes) - 1
    most = FINER_RAYS if programs.method.renders_pixels else FINER
    rendered = pyramid.level_near(most * cameras.width)
    views = range(len(scene.train)) if views is None else views
    values = np.empty((len(views), pyramid.values.shape[1], 6), np.int8)

    def compare(view):
        """Level, what is shown, weight, colors, opacity and depth, the coarsest first."""
        found = []
        for level in range(last, -1, -1):
            camera = pyramid.camera(camera_at(cameras, view), view, level)
            photograph = pyramid.image(view, level)
            if level >= rendered:
                seen = programs.render(state, camera)
                depth = label_depth(seen, near=scene.near, far=scene.far)
                shown, shown_by = (seen.rgb, seen.alpha, depth), camera
            else:
                shown, shown_by = _enlarge(shown, shown_by, camera), camera
            if level == last:
                # The size that the model learned from shows the exposure.
                colors = _match(photograph, *shown[:2])
            found.append((level, *_subtract(photograph, shown[0], colors), *shown))
        return [(level, *map(np.asarray, images)) for level, *images in found]

    windows, depths, rng = [], [], np.random.default_rng(0)
    compared = progress.each(compare, views, "residuals of photographs")
    for view, own, found in zip(views, values, compared, strict=True):
        depths.append(found[0][-1])
        for level, both, weight, rgb, alpha, depth in found:
            own[pyramid.pixels_of(level)] = both.reshape(-1, 6)
            if view in left_out:
                images = [rgb, both[..., :3] / np.float32(127), weight, depth, alpha]
                windows += _cut(rng, view, level, pyramid.sizes, images)
    found = Pyramid(jnp.asarray(values), pyramid.intrinsics[np.asarray(views)], pyramid.sizes)
    return found, windows, jnp.stack(depths)


def _enlarge(shown, camera, finer):
    """Colors, opacity and depth of a render as a camera with the same pose and finer pixels."""
    (fx, fy, cx, cy), (gx, gy, dx, dy) = map(np.asarray, (camera.intrinsics, finer.intrinsics))
    x = (np.arange(finer.width) + 0.5 - dx) / gx * fx + cx - 0.5
    y = (np.arange(finer.height) + 0.5 - dy) / gy * fy + cy - 0.5
    where = [axis.astype(np.float32) for axis in np.meshgrid(x, y)]
    ways = cv2.INTER_CUBIC, cv2.INTER_NEAREST, cv2.INTER_NEAREST
    return tuple(
        cv2.remap(np.asarray(image), *where, way, borderMode=cv2.BORDER_REPLICATE)
        for image, way in zip(shown, ways, strict=True)
    )


def _cut(rng, view, level, sizes, shown):
    """Windows of a photograph, for each finest level that others may show there."""
    side = min(WINDOW, *sizes[-1])
    height, width = sizes[level]
    for finest in (0, *range(level + 1, len(sizes))):
        for _ in range(WINDOWS):
            y, x = rng.integers(height - side + 1), rng.integers(width - side + 1)
            inside = np.s_[y : y + side, x : x + side]
            corner = np.array([x, y], np.float32)
            yield Window(view, level, finest, corner, *(image[inside] for image in shown))


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
    """Residual and matched colors of a photograph, int8 `[H, W, 6]`, and its weight."""
    values, (matrix, offset) = to_float(photograph), colors
    weight = values[..., 3]
    matched = matmul(values[..., :3], matrix[None]) + offset[None, None]
    both = jnp.concatenate([matched - jnp.clip(rgb, 0, 1), 2 * matched - 1], axis=-1)
    both = jnp.where(weight[..., None] > 0, both, 0)
    return jnp.round(127 * jnp.clip(both, -1, 1)).astype(jnp.int8), weight
