"""Adaptive density control (Kerbl et al. 2023) as 2D Gaussian splatting has it, at fixed capacity.

Surfels whose images are pulled about hard are too few there: small ones are cloned, large ones
split in two. Faint and huge ones are removed, and all opacities lowered now and then, so that what
is not needed fades. What is added goes where there is room; when there is none, the surfels pulled
hardest come first. Unlike in the published code, the pull has the low-pass filter's share and that
of colors that depend on the direction, and views in which it is 0 do not count.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.numerics import matmul, safe_norm
from jaxcloseup.splats.surfels import Surfels


@dataclasses.dataclass(frozen=True)
class AdaptiveConfig:
    """When surfels are added and removed; lengths are in extents of the capture.

    Attributes:
      every: steps between refinements.
      start: no refinement up to this step.
      stop: no refinement and no reset from this step on.
      gradient: surfels are added where the norm of the loss's gradient with respect to the center's
        image, in half images, is at least this, in the mean over the views that had one.
      small: scale up to which a surfel is cloned; a larger one is split.
      shrink: a split surfel's scales over its halves'.
      min_opacity: fainter surfels are removed.
      huge: larger surfels are removed, unless they are split, from the first reset on.
      reset_every: steps between resets of the opacities.
      reset_opacity: what a reset leaves at most.
    """

    every: int = 100
    start: int = 500
    stop: int = 15_000
    gradient: float = 2e-4
    small: float = 0.01
    shrink: float = 1.6
    min_opacity: float = 0.05
    huge: float = 0.1
    reset_every: int = 3000
    reset_opacity: float = 0.01


@struct.dataclass
class ProbedSurfels(Surfels):
    """Surfels with a parameter that is always 0 and whose gradient is of interest.

    Attributes:
      probe: `[N, 2]` how far the center's image is moved, in half images: -1 to 1 is the width.
    """

    probe: jax.Array


class PullState(struct.PyTreeNode):
    """How hard the images of surfels were pulled since the last refinement.

    Attributes:
      total: `[N]` sum of norms of the probe's gradient.
      views: `[N]` in how many views it was not 0.
    """

    total: jax.Array
    views: jax.Array


def with_probe(surfels: Surfels) -> ProbedSurfels:
    """The same surfels, with a probe."""
    leaves = {f.name: getattr(surfels, f.name) for f in dataclasses.fields(Surfels)}
    return ProbedSurfels(**leaves, probe=jnp.zeros_like(surfels.log_scales))


def apply_probe(surfels: ProbedSurfels, camera: Camera) -> ProbedSurfels:
    """Surfels moved by their probes in parallel to the image plane: by nothing, for these are 0."""
    offset = jax.lax.stop_gradient(surfels.means) - camera.position[None]
    depth = matmul(offset, camera.rotation)[:, 2:]
    half_image = jnp.array([[camera.width / 2, camera.height / 2]], depth.dtype)
    moved = surfels.probe * half_image * depth / camera.intrinsics[None, :2]
    return surfels.replace(means=surfels.means + matmul(moved, camera.rotation[:, :2].T))


def measure_pull() -> optax.GradientTransformation:
    """Keep a record of the probe's gradients in the optimizer's state; updates pass through."""

    def init(params):
        zeros = jnp.zeros(params.probe.shape[0], params.probe.dtype)
        return PullState(zeros, zeros)

    def update(updates, state, params=None):
        del params
        norm = safe_norm(updates.probe)
        return updates, PullState(state.total + norm, state.views + (norm > 0))

    return optax.GradientTransformation(init, update)


def refine(
    key: jax.Array,
    surfels: ProbedSurfels,
    alive: jax.Array,
    pull: PullState,
    config: AdaptiveConfig,
    *,
    extent: float,
    remove_huge: jax.Array,
) -> tuple[ProbedSurfels, jax.Array, jax.Array]:
    """Clone, split and remove surfels; `key` is consumed.

    A clone is an exact copy. A split surfel is replaced by two, drawn from its own Gaussian in its
    plane, whose scales are smaller by `shrink`.

    Args:
      key: random key.
      surfels: `N` surfels.
      alive: `[N]` bool.
      pull: since the last refinement.
      config: static.
      extent: of the capture in world units.
      remove_huge: `[]` whether size is a reason to remove.

    Returns:
      Surfels, `alive`, and `[N]` whether a surfel is new, so that an optimizer forgets it.
    """
    count = alive.shape[0]
    scale = jnp.max(jnp.exp(surfels.log_scales), axis=-1) / extent
    mean_pull = pull.total / jnp.maximum(pull.views, 1)
    opaque = alive & (jax.nn.sigmoid(surfels.opacity_logits) >= config.min_opacity)
    wanted = opaque & (mean_pull >= config.gradient)
    keep = opaque & (wanted | ~(remove_huge & (scale > config.huge)))
    hardest = jnp.argsort(jnp.where(wanted, -mean_pull, 1), stable=True)
    room = jnp.argsort(keep, stable=True)
    number = jnp.minimum(jnp.sum(wanted), jnp.sum(~keep))
    granted = jnp.arange(count) < number
    place = jnp.where(granted, room, count)  # out of bounds, and so dropped
    source = jnp.arange(count).at[place].set(hardest, mode="drop")
    added = jnp.zeros(count, bool).at[place].set(True, mode="drop")
    parent = jnp.zeros(count, bool).at[jnp.where(granted, hardest, count)].set(True, mode="drop")

    split = (parent | added) & (scale[source] > config.small)
    surfels = jax.tree.map(lambda leaf: leaf[source], surfels)
    tangents = quaternion_to_matrix(surfels.quaternions)[..., :2]
    step = jax.random.normal(key, (count, 2), surfels.means.dtype) * jnp.exp(surfels.log_scales)
    moved = surfels.means + jnp.sum(tangents * step[:, None], axis=-1)
    surfels = surfels.replace(
        means=jnp.where(split[:, None], moved, surfels.means),
        log_scales=surfels.log_scales - jnp.where(split, jnp.log(config.shrink), 0)[:, None],
    )
    return surfels, keep | added, added | split


def reset_opacities(surfels: ProbedSurfels, config: AdaptiveConfig) -> ProbedSurfels:
    """No surfel more opaque than `config.reset_opacity`."""
    most = jnp.log(config.reset_opacity / (1 - config.reset_opacity))
    return surfels.replace(opacity_logits=jnp.minimum(surfels.opacity_logits, most))
