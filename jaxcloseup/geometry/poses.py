"""Virtual close-up cameras, drawn between a training camera and the surface that it sees.

Symbols as in the paper: anchor X_a, training position t_n, magnification lambda, Euler angles e,
angular range epsilon:

    X_a = o + D_n(a) d_a                       a is a random pixel of view n, D_n its depth map
    t'  = ((lambda - 1) X_a + t_n) / lambda    lambda ~ U(2, 8)
    e'  = e(R_n) + delta                       delta_i ~ U(-epsilon, epsilon), R = Rz Ry Rx
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxcloseup.geometry.cameras import Camera, pixels_to_points
from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.geometry.rotations import euler_to_matrix, matrix_to_euler


class PoseSettings(struct.PyTreeNode):
    """Ranges that virtual cameras are drawn from; every leaf is traced.

    Attributes:
      magnification: `[2]` range (lo, hi) of lambda, how many times nearer the camera comes.
      max_angle: `[]` epsilon, largest change of each Euler angle, radians.
      anchor_tolerance: `[]` anchors have a depth D with |D - mean D| < tolerance * mean D; inf
        accepts every pixel.
      look_at: `[]` 1 turns the camera about the anchor, which stays at its pixel; 0 turns the
        camera about itself, as published.
    """

    magnification: jax.Array
    max_angle: jax.Array
    anchor_tolerance: jax.Array
    look_at: jax.Array = struct.field(default_factory=lambda: jnp.zeros(()))


def closeup_position(
    anchor: jax.Array, position: jax.Array, magnification: jax.Array | float
) -> jax.Array:
    """Return the camera position `[3]` at 1/lambda of the distance to the anchor.

    t' = ((lambda - 1) X_a + t_n) / lambda, so |t' - X_a| = |t_n - X_a| / lambda.
    """
    chex.assert_equal_shape([anchor, position])
    return ((magnification - 1) * anchor + position) / magnification


def sample_anchor(key: jax.Array, depth: jax.Array, weight: jax.Array) -> jax.Array:
    """Draw a pixel center `[2]` with probability proportional to `weight`; `key` is consumed.

    Args:
      key: random key.
      depth: `[H, W]` z-depth; pixels where it is not positive and finite are never drawn.
      weight: `[H, W]` non-negative; pixels of weight 0 are never drawn.

    Returns:
      (x, y) of a pixel center; the top-left center if no pixel can be drawn.
    """
    chex.assert_rank([depth, weight], 2)
    chex.assert_equal_shape([depth, weight])
    weight = jnp.where((depth > 0) & jnp.isfinite(depth), weight, 0)
    # Draw the row, then a pixel in it: two short draws instead of one over the whole image.
    key_row, key_column = jax.random.split(key)
    row = jax.random.categorical(key_row, jnp.log(jnp.sum(weight, axis=1)))
    column = jax.random.categorical(key_column, jnp.log(weight[row]))
    return jnp.stack([column, row]).astype(depth.dtype) + 0.5


def four_anchors(height: int, width: int) -> jax.Array:
    """Return the anchor weights `[height, width]` of the ablation without diverse poses.

    The weight is 1 at the center of each quadrant and 0 elsewhere. Pass it as the `weight` of
    `sample_closeup_camera`, with magnification (4, 4) and max_angle 0.
    """
    rows = jnp.array([height // 4, height // 4, 3 * height // 4, 3 * height // 4])
    columns = jnp.array([width // 4, 3 * width // 4, width // 4, 3 * width // 4])
    return jnp.zeros((height, width)).at[rows, columns].set(1)


def perturb_rotation(
    key: jax.Array, rotation: jax.Array, max_angle: jax.Array | float
) -> jax.Array:
    """Turn a camera by a uniform offset of each Euler angle: e' = e + U(-epsilon, epsilon).

    The paper prints an interval of the offset that is centered on e; its text and the released
    script mean one that is centered on 0.

    Args:
      key: random key; consumed.
      rotation: `[3, 3]` camera-to-world rotation.
      max_angle: `[]` epsilon, radians.
    """
    chex.assert_shape(rotation, (3, 3))
    offset = jax.random.uniform(key, (3,), rotation.dtype, -1, 1) * max_angle
    return euler_to_matrix(matrix_to_euler(rotation) + offset)


def sample_closeup_camera(
    key: jax.Array,
    camera: Camera,
    depth: jax.Array,
    settings: PoseSettings,
    weight: jax.Array | None = None,
) -> Camera:
    """Draw a virtual close-up camera from a training view; `key` is consumed.

    Args:
      key: random key.
      camera: one training camera.
      depth: `[H, W]` z-depth of its view; 0 where undefined.
      settings: ranges to draw from.
      weight: `[H, W]` anchor weights; 1 everywhere by default.

    Returns:
      A camera with the intrinsics and size of `camera`.
    """
    chex.assert_shape(depth, (camera.height, camera.width))
    key_anchor, key_magnification, key_rotation = jax.random.split(key, 3)
    weight = jnp.ones_like(depth) if weight is None else weight
    defined = (depth > 0) & jnp.isfinite(depth)
    mean = jnp.mean(depth, where=defined)  # NaN without any defined depth: no pixel is typical
    typical = jnp.abs(depth - mean) < settings.anchor_tolerance * mean
    pixel = sample_anchor(key_anchor, depth, jnp.where(typical, weight, 0))
    column, row = jnp.floor(pixel).astype(jnp.int32)
    anchor_depth = jnp.where(defined[row, column], depth[row, column], 0)
    anchor = pixels_to_points(camera, pixel, anchor_depth)
    low, high = settings.magnification
    magnification = low + (high - low) * jax.random.uniform(key_magnification, (), depth.dtype)
    position = closeup_position(anchor, camera.position, magnification)
    rotation = perturb_rotation(key_rotation, camera.rotation, settings.max_angle)
    # After a turn about the anchor, the camera still sees the anchor at its pixel.
    turn = matmul(rotation, camera.rotation.T)
    about_anchor = anchor + matmul(turn, (position - anchor)[:, None])[:, 0]
    position = jnp.where(settings.look_at > 0, about_anchor, position)
    return camera.replace(camtoworld=jnp.concatenate([rotation, position[:, None]], axis=1))
