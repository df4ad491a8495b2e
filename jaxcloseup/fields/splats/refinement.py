"""Small surfels where photographs show more than a model.

Density control splits surfels and moves the parts apart by chance. Where depth is already known,
a pixel of a photograph determines where its surfel belongs, how large it is and its color.
"""

import math

import jax
import jax.numpy as jnp

from jaxcloseup.fields.splats.regularizers import depth_to_normal
from jaxcloseup.fields.splats.spherical_harmonics import rgb_to_sh
from jaxcloseup.fields.splats.surfels import Surfels, pad_rows
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.numerics import safe_divide, safe_norm


SIZE = 0.7  # standard deviation of a new surfel, in pixels
OPACITY = 0.5
IN_FRONT = 0.002  # share of the depth by which new surfels lie in front of those they refine
_STEEPEST = 0.2  # cosine below which depth shows an edge, not a surface


def surfels_where_wrong(
    key: jax.Array,
    camera: Camera,
    photograph: jax.Array,
    weight: jax.Array,
    rgb: jax.Array,
    depth: jax.Array,
    *,
    count: int,
    sh_degree: int,
    num_scales: int = 2,
) -> tuple[Surfels, jax.Array]:
    """Return surfels at pixels of a photograph, drawn in proportion to the error of its render.

    Args:
      key: consumed.
      camera: of the photograph.
      photograph: `[H, W, 3]` in [0, 1].
      weight: `[H, W]` weights of its pixels.
      rgb: `[H, W, 3]` rendered colors.
      depth: `[H, W]` rendered z-depth; 0 is undefined.
      count: number of surfels.
      sh_degree: degree of their harmonics; only the constant color is not 0.
      num_scales: 2 of discs, 3 of volumetric Gaussians, which are round.

    Returns:
      `count` surfels, and `[count]` bool: False where too few pixels had an error.
    """
    error = weight * jnp.mean(jnp.abs(photograph - jnp.clip(rgb, 0, 1)), axis=-1)
    error = jnp.where(depth > 0, error, 0).reshape(-1)
    # The largest of these values are draws without replacement (Gumbel).
    noisy = jnp.log(error) + jax.random.gumbel(key, error.shape)
    largest, chosen = jax.lax.top_k(noisy, count)

    def pick(image: jax.Array) -> jax.Array:
        return image.reshape(error.size, *image.shape[2:])[chosen]

    pixels, distance = pick(pixel_grid(camera.height, camera.width)), pick(depth)
    means = pixels_to_points(camera, pixels, distance * (1 - IN_FRONT))
    towards = camera.position[None] - means
    towards = safe_divide(towards, safe_norm(towards, keepdims=True))
    normal = pick(depth_to_normal(camera, depth))
    # At an edge of the depth map, and where it has no normal, a surfel faces the camera.
    facing = jnp.sum(normal * towards, axis=-1, keepdims=True)
    normal = jnp.where(jnp.abs(facing) < _STEEPEST, towards, normal)
    scale = jnp.log(SIZE * jnp.maximum(distance, 1e-12) / camera.intrinsics[0])
    colors = rgb_to_sh(pick(photograph))[:, None]
    surfels = Surfels(
        means=means,
        log_scales=jnp.stack([scale] * num_scales, axis=-1),
        quaternions=_turn_to(normal),
        opacity_logits=jnp.full(count, math.log(OPACITY / (1 - OPACITY)), means.dtype),
        sh=jnp.pad(colors, ((0, 0), (0, (sh_degree + 1) ** 2 - 1), (0, 0))),
    )
    return surfels, jnp.isfinite(largest)


def _turn_to(normal: jax.Array) -> jax.Array:
    """Return quaternions `[N, 4]` that turn the z-axis to unit normals `[N, 3]`."""
    x, y, z = jnp.moveaxis(normal, -1, 0)
    none = jnp.zeros_like(x)
    # Half way between both axes, unnormalized: it vanishes where they are opposite.
    turn = jnp.stack([1 + z, -y, x, none], axis=-1)
    upside_down = jnp.stack([none, none + 1, none, none], axis=-1)
    return jnp.where((z < -0.9999)[:, None], upside_down, turn)


def join_surfels(
    old: tuple[Surfels, jax.Array], new: tuple[Surfels, jax.Array], capacity: int
) -> tuple[Surfels, jax.Array]:
    """Return the living surfels of both, old ones first, in `capacity` rows without the rest.

    Args:
      old: surfels and their `alive`.
      new: the same.
      capacity: number of rows; static.
    """
    surfels, alive = jax.tree.map(lambda *rows: jnp.concatenate(rows), old, new)
    order = jnp.argsort(~alive, stable=True)[:capacity]
    return jax.tree.map(lambda leaf: pad_rows(leaf[order], capacity), (surfels, alive))


def replace_least(
    surfels: Surfels, alive: jax.Array, new: Surfels, new_alive: jax.Array
) -> tuple[Surfels, jax.Array, jax.Array]:
    """Put new surfels into free rows, then into those of the least opacity times area.

    Args:
      surfels: `N` surfels.
      alive: `[N]` bool.
      new: `M` surfels, at most N.
      new_alive: `[M]` bool; other new surfels are left out.

    Returns:
      `N` surfels, their `alive`, and `[N]` bool, True where a surfel is new.
    """
    size = jnp.sum(surfels.log_scales, axis=-1)
    shown = jnp.where(alive, jax.nn.log_sigmoid(surfels.opacity_logits) + size, -jnp.inf)
    rows = jnp.argsort(shown, stable=True)[: new_alive.shape[0]]
    # The first rows are for living new surfels; an index out of bounds drops the others.
    rank = jnp.cumsum(new_alive) - 1
    place = jnp.where(new_alive, rows[rank], alive.shape[0])

    def put(leaf: jax.Array, values: jax.Array) -> jax.Array:
        return leaf.at[place].set(values, mode="drop")

    changed = put(jnp.zeros_like(alive), new_alive)
    return jax.tree.map(put, surfels, new), alive | changed, changed
