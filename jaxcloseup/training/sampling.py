"""What a training step draws at random, and the mean of what several draws give.

What a draw gives depends on its keys alone, so draws may be taken in one loop, in threads, or on
several devices; the mean is the same but for the order of its sums.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import LabelSources, PseudoSettings, sample_virtual_camera
from jaxcloseup.photos.views import Batch, Views, sample_image, sample_pixels
from jaxcloseup.photos.windows import Windows, sample_window, sample_window_pixels


# The mean of `give(keys, *shared)` over stacked keys.
Spread = Callable[..., Any]


class DrawKeys(NamedTuple):
    """Random keys of one draw, or stacked keys of several.

    Attributes:
      batch: draws photographs.
      render: renders them.
      label: draws labels, and renders them.
    """

    batch: jax.Array
    render: jax.Array
    label: jax.Array


@functools.partial(jax.jit, static_argnums=2)
def draw_keys(key: jax.Array, step: jax.Array, draws: int) -> tuple[DrawKeys, jax.Array]:
    """Keys of a step's draws, stacked if there are several, and one for what follows them."""
    batch, render, after, label = jax.random.split(jax.random.fold_in(key, step), 4)
    keys = DrawKeys(batch, render, label)
    if draws == 1:
        return keys, after
    each = jax.vmap(jax.random.fold_in, in_axes=(None, 0))
    return jax.tree.map(lambda key: each(key, jnp.arange(draws)), keys), after


@functools.partial(jax.jit, static_argnums=2)
def sample_batch(key: jax.Array, views: Views | Windows, count: int | None) -> Batch:
    """`count` pixels of photographs, or a whole photograph or window; consumes `key`."""
    whole, single = (
        (sample_window, sample_window_pixels)
        if isinstance(views, Windows)
        else (sample_image, sample_pixels)
    )
    return whole(key, views) if count is None else single(key, views, count)


@functools.partial(jax.jit, static_argnums=2)
def sample_labels(
    key: jax.Array, labels: Views | Windows, count: int | None
) -> tuple[Batch, jax.Array]:
    """`count` pixels of labeled views, or a whole one, and a key that renders them."""
    key_batch, key_render = jax.random.split(key)
    return sample_batch(key_batch, labels, count), key_render


class CloseupDraw(NamedTuple):
    """A random close-up.

    Attributes:
      camera: the virtual camera.
      source_index: `[]` int32, the photograph that it comes from.
      pixels: `[count, 2]` pixel centers, drawn with replacement; None: all.
      key_depth: renders its depth.
      key_render: renders its pixels.
    """

    camera: Camera
    source_index: jax.Array
    pixels: jax.Array | None
    key_depth: jax.Array
    key_render: jax.Array


@functools.partial(jax.jit, static_argnums=3)
def sample_closeup(
    key: jax.Array, sources: LabelSources, settings: PseudoSettings, count: int | None
) -> CloseupDraw:
    """A random close-up, of which `count` pixels are looked at, or all; consumes `key`."""
    key_virtual, key_pixels, key_depth, key_render = jax.random.split(key, 4)
    camera, source_index = sample_virtual_camera(key_virtual, sources, settings)
    pixels = None
    if count is not None:
        size = jnp.array([[camera.width, camera.height]])
        pixels = jax.random.randint(key_pixels, (count, 2), 0, size).astype(jnp.float32) + 0.5
    return CloseupDraw(camera, source_index, pixels, key_depth, key_render)


def in_a_loop(give: Callable[..., Any], keys: Any, *shared: Any) -> Any:
    """The mean of `give(keys, *shared)` over draws, one after the other in one compiled loop.

    Args:
      give: `(keys, *shared) -> tree of arrays`.
      keys: tree of random keys `[D]`, a row for each draw.
      *shared: trees of arrays that all draws use.
    """
    return jax.tree.map(lambda leaf: leaf / _count(keys), _sum(give, keys, *shared))


def in_threads(workers: int) -> Spread:
    """Draws in up to `workers` threads of the host, for what `jax.jit` compiles in parts.

    XLA uses several cores for large arrays alone; two draws at once keep two cores busier. Not for
    use inside `jax.jit`.
    """

    def spread(give, keys, *shared):
        draws = [jax.tree.map(lambda key, i=i: key[i], keys) for i in range(_count(keys))]
        if workers == 1:
            return _mean([give(draw, *shared) for draw in draws])

        def wait(draw):
            return jax.block_until_ready(give(draw, *shared))

        with ThreadPoolExecutor(workers) as pool:
            return _mean(list(pool.map(wait, draws)))

    return spread


def over_devices(mesh: Mesh) -> Spread:
    """Draws shared out among the devices of a mesh of one axis, which must divide their number.

    Every device has what the draws share, whole.
    """
    (axis,) = mesh.axis_names

    def spread(give, keys, *shared):
        total = jax.shard_map(
            lambda keys, *shared: jax.lax.psum(_sum(give, keys, *shared), axis),
            mesh=mesh,
            in_specs=(PartitionSpec(axis), *[PartitionSpec()] * len(shared)),
            out_specs=PartitionSpec(),
            check_vma=False,
        )(keys, *shared)
        return jax.tree.map(lambda leaf: leaf / _count(keys), total)

    return spread


def _count(keys):
    return len(jax.tree.leaves(keys)[0])


def _sum(give, keys, *shared):
    def add(total, keys):
        return jax.tree.map(jnp.add, total, give(keys, *shared)), None

    one = jax.eval_shape(give, jax.tree.map(lambda key: key[0], keys), *shared)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), one)
    return jax.lax.scan(add, zeros, keys)[0]


@jax.jit
def _mean(given):
    total = functools.reduce(functools.partial(jax.tree.map, jnp.add), given)
    return jax.tree.map(lambda leaf: leaf / len(given), total)
