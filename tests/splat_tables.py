"""Draw random tables of splats, as projections make them, without projecting anything."""

import hashlib

import numpy as np

from jaxcloseup.fields.splats.layout import (
    ANCHOR,
    HOMOGRAPHY,
    INVERSE_DEPTH,
    LOW_PASS,
    OPACITY,
    PAYLOAD,
)


NEAR = 0.2


def random_table(seed, count, height, width, features=6, *, sigma=(0.3, 8.0)):
    """Draw tilted discs in front of the near plane.

    Args:
      seed: of the generator.
      count: number of discs.
      height: of the image in pixels.
      width: of the image in pixels.
      features: number of values of a payload.
      sigma: range of their standard deviations in pixels.

    Returns:
      A table `[N, PAYLOAD + F]`, boxes `[N, 4]` and orders `[N]`, float32.
    """
    rng = np.random.default_rng(seed)
    anchor = rng.uniform(-4, np.array([width, height]) + 4, (count, 2))
    angle = rng.uniform(0, np.pi, count)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    axes = turn.transpose(2, 0, 1) * np.exp(rng.uniform(*np.log(sigma), (count, 1, 2)))
    inverse_depth = rng.uniform(0.3, 1, (count, 1))
    opacity = rng.uniform(0.01, 1, count)
    cutoff = np.sqrt(2 * np.log(np.maximum(255 * opacity, 1)))
    table = np.zeros((count, PAYLOAD + features))
    table[:, ANCHOR:HOMOGRAPHY] = anchor
    homography = table[:, HOMOGRAPHY:OPACITY].reshape(count, 3, 3)
    homography[:, :2, 1:] = np.linalg.inv(axes) * inverse_depth[..., None]
    # Depths differ by a twentieth over a disc.
    slopes = 0.05 * inverse_depth * rng.uniform(-1, 1, (count, 2))
    slopes /= np.maximum(cutoff, 1)[:, None]
    homography[:, 2, :1] = inverse_depth
    homography[:, 2:, 1:] = slopes[:, None] @ np.linalg.inv(axes)
    table[:, OPACITY] = opacity
    table[:, LOW_PASS] = 2
    table[:, INVERSE_DEPTH : INVERSE_DEPTH + 2] = inverse_depth * [0.95, 1.05]
    table[:, PAYLOAD:] = rng.normal(size=(count, features))
    half = 1.2 * cutoff[:, None] * np.maximum(np.linalg.norm(axes, axis=2), 1)
    box = np.concatenate([anchor - half, anchor + half], axis=1)
    return tuple(a.astype(np.float32) for a in (table, box, 1 / inverse_depth[:, 0]))


def digest():
    """Return a hash of an image of many splats and of its derivative, by the native library."""
    import jax
    import jax.numpy as jnp

    from jaxcloseup.fields.splats import blend_native
    from jaxcloseup.fields.splats.config import RasterPlan
    from jaxcloseup.native import library

    assert library.available(), library.missing()
    height, width = 130, 211
    arrays = random_table(0, 5000, height, width)
    plan = RasterPlan(capacity=1, near=NEAR, tile=4)

    def both(table, box, order):
        def image(table):
            return blend_native.blend_image(plan, height, width, table, box, order)

        images, pull = jax.vjp(image, table)
        return images, pull(jax.tree.map(jnp.sin, images))

    result = jax.tree.leaves(jax.jit(both)(*arrays))
    return hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in result)).hexdigest()
