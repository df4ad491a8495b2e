"""The renderer of intervals: rounds that cut rays ever finer where the round before saw something.

Each round asks a field for the densities of its intervals, the last one also for colors. A round
without colors is a *proposal*: the last round's weights supervise it, through a penalty. Distances
along rays are z-depths, or *spaced* in [0, 1], where the first round's intervals are even. Rays are
`[R]`, intervals `[R, S]` with edges `[R, S + 1]`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from jaxcloseup.fields.contract import RadianceField, Rendering
from jaxcloseup.fields.volume.compositing import composite_intervals
from jaxcloseup.fields.volume.coordinates import unspaced
from jaxcloseup.fields.volume.depth_supervision import DepthSupervision
from jaxcloseup.fields.volume.rays import Extent, Rays, Traced, VolumeAux, ray_field
from jaxcloseup.fields.volume.renderer import Samples
from jaxcloseup.fields.volume.samplers import interval_quantiles, resample


class Histogram(NamedTuple):
    """The result of a round: `weights [R, S]` of intervals with spaced `edges [R, S + 1]`."""

    edges: jax.Array
    weights: jax.Array


class Round(NamedTuple):
    """One round of samples.

    Attributes:
      num_intervals: intervals per ray.
      query: `(params, buffers, key, rays, edges [R, S + 1]) -> Samples`; edges are z-depths.
        Proposals may leave out colors.
    """

    num_intervals: int
    query: Callable[[Any, Any, jax.Array | None, Rays, jax.Array], Samples]


@dataclasses.dataclass(frozen=True)
class IntervalConfig:
    """How rays are cut and rendered.

    Attributes:
      spacing: exponent of the first round's spacing, see `spaced`: 1 is even in depth.
      background: gray level in [0, 1] behind the scene; None adds nothing, which is black.
      chunk: rays rendered, and in training differentiated, at once; None for all.
    """

    spacing: float = 1.0
    background: float | None = None
    chunk: int | None = None


def interval_field(
    config: IntervalConfig,
    extent: Extent,
    *,
    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]],
    rounds: Sequence[Round],
    penalty: Callable[[Any, Any, list[Histogram]], jax.Array] | None = None,
    blur: Callable[[jax.Array], jax.Array] = lambda weights: weights,
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None,
    supervision: DepthSupervision | None = None,
) -> RadianceField:
    """Return a radiance field that cuts rays into intervals, round after round.

    Args:
      config: spacing and chunking.
      extent: z-depths of the first and the last edge, and the field's coordinates.
      init: `(key, points [P, 3], rgb [P, 3]) -> (params, buffers)`.
      rounds: first to last.
      penalty: `(params, buffers, histograms) -> [R]`, added to the loss of each ray; gets one
        histogram a round.
      blur: `[R, S] -> [R, S]`, what weights become before the next round is drawn from them.
      loss: `photometric_loss` by default.
      supervision: see `ray_field`.
    """
    near, far = extent.near * extent.scale, extent.far * extent.scale

    def trace(params: Any, buffers: Any, key: jax.Array | None, rays: Rays) -> Traced:
        keys = [None] * 2 * len(rounds) if key is None else jax.random.split(key, 2 * len(rounds))
        histograms: list[Histogram] = []
        seen, colored = [], []
        for i, (count, query) in enumerate(rounds):
            if not histograms:
                edges = interval_quantiles(keys[0], count, rays.length.shape)
            else:
                before = histograms[-1]
                edges = resample(keys[2 * i], before.edges, blur(before.weights), count)
            depth = unspaced(edges, near, far, spacing=config.spacing) / extent.scale
            samples = query(params, buffers, keys[2 * i + 1], rays, depth)
            light = composite_intervals(samples.rgb, samples.density, depth, rays.length)
            histograms.append(Histogram(edges, light.weights))
            if samples.rgb is not None:
                seen.append(light.over(config.background))
                colored.append((depth, light.weights))
        fine, coarse_rgb = seen[-1], seen[0].rgb if len(seen) > 1 else None
        more = None if penalty is None else penalty(params, buffers, histograms)
        aux = VolumeAux(coarse_rgb, fine.median_depth, fine.expected_depth, more)
        return Traced(Rendering(fine.rgb, fine.depth, fine.alpha, aux), colored)

    return ray_field(
        extent, init=init, trace=trace, chunk=config.chunk, loss=loss, supervision=supervision
    )
