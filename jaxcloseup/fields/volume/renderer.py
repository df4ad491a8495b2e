"""The renderer of point samples: it asks a field for densities and colors, and composites them.

A volumetric field brings its parameters and a *query function*; sampling, the coarse and the fine
pass and compositing are the same for all of them. Rays are `[R]`, their samples `[R, S]`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.volume.compositing import Composite, composite
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.rays import Extent, Rays, Traced, VolumeAux, ray_field
from jaxcloseup.fields.volume.samplers import importance, stratified


@dataclasses.dataclass(frozen=True)
class VolumeConfig:
    """How rays are sampled and rendered.

    Attributes:
      num_coarse: stratified samples per ray of the coarse pass.
      num_fine: importance samples per ray; the fine pass sees these and the coarse ones.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered, and in training differentiated, at once; None for all.
    """

    num_coarse: int = 64
    num_fine: int = 64
    background: float | None = None
    chunk: int | None = None


class Samples(NamedTuple):
    """What a query function returns for S samples on each of R rays.

    Attributes:
      density: `[R, S]` non-negative, per world unit, whatever the scale of the field's coordinates.
      rgb: `[R, S, 3]` colors in [0, 1]; None from what asks for densities alone.
    """

    density: jax.Array
    rgb: jax.Array | None


Query = Callable[[Any, Any, str, jax.Array | None, jax.Array, jax.Array], Samples]


def volume_field(
    config: VolumeConfig,
    extent: Extent,
    *,
    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]],
    query: Query,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """Return a radiance field that samples rays twice, the second time where the first saw light.

    Args:
      config: sampling and chunking.
      extent: z-depths of the first and the last samples, and the field's coordinates.
      init: `(key, points [P, 3], rgb [P, 3]) -> (params, buffers)`.
      query: `(params, buffers, stage, key, positions [3, R, S], directions [3, R]) -> Samples`.
        `stage` is "coarse" or "fine"; a field with one set of parameters ignores it. `key` is None
        in a deterministic rendering, else the query may use it, to add noise for instance.
        Positions are in the field's coordinates, directions are unit vectors; both have their
        coordinates first.
      supervision: see `ray_field`.

    Returns:
      A field whose `render` takes single pixels, also with stacked cameras, whose `loss` is
      `photometric_loss` and whose `aux` is a `VolumeAux`.
    """

    def trace(params: Any, buffers: Any, key: jax.Array | None, rays: Rays) -> Traced:
        return _two_passes(config, extent, functools.partial(query, params, buffers), key, rays)

    return ray_field(extent, init=init, trace=trace, chunk=config.chunk, supervision=supervision)


def _two_passes(
    config: VolumeConfig,
    extent: Extent,
    query: Callable[..., Samples],
    key: jax.Array | None,
    rays: Rays,
) -> Traced:
    """Render a coarse pass, and a fine pass with importance samples beside the coarse ones."""
    near, far = extent.near, extent.far
    keys = (None,) * 4 if key is None else jax.random.split(key, 4)
    key_coarse, key_fine, key_coarse_query, key_fine_query = keys

    def see(stage: str, key: jax.Array | None, depth: jax.Array) -> Composite:
        samples = query(stage, key, rays.at(depth), rays.unit)
        assert samples.rgb is not None  # both passes have colors
        chex.assert_shape(samples.density, depth.shape)
        return composite(samples.rgb, samples.density, depth, rays.length)

    def light(depth: jax.Array, seen: Composite) -> tuple[jax.Array, jax.Array]:
        # Each sample stands for the interval up to the next, the last one for the rest.
        return jnp.concatenate([depth, jnp.full_like(depth[..., :1], far)], axis=-1), seen.weights

    depth = stratified(key_coarse, near, far, config.num_coarse, rays.length.shape)
    coarse = see("coarse", key_coarse_query, depth)
    first = light(depth, coarse)
    middles = 0.5 * (depth[..., 1:] + depth[..., :-1])
    more = importance(key_fine, middles, coarse.weights[..., 1:-1], config.num_fine)
    depth = jnp.sort(jnp.concatenate([depth, more], axis=-1), axis=-1)
    fine = see("fine", key_fine_query, depth)
    coarse_rgb = coarse.over(config.background).rgb
    aux = VolumeAux(coarse_rgb, fine.median_depth, fine.expected_depth)
    rendering = Rendering(fine.over(config.background).rgb, fine.depth, fine.alpha, aux)
    return Traced(rendering, [first, light(depth, fine)])
