"""What a training step draws at random: photographs, labels, virtual close-ups.

The functions are compiled by themselves, because a step of a field that renders whole images is not
compiled as one program: all kinds of steps share these parts.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import LabelSources, PseudoSettings, sample_virtual_camera
from jaxcloseup.photos.views import Batch, Views, sample_image, sample_pixels
from jaxcloseup.photos.windows import Windows, sample_window, sample_window_pixels


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
    """Return the keys of a step's draws, stacked if there are several, and one for what follows."""
    batch, render, after, label = jax.random.split(jax.random.fold_in(key, step), 4)
    keys = DrawKeys(batch, render, label)
    if draws == 1:
        return keys, after
    each = jax.vmap(jax.random.fold_in, in_axes=(None, 0))
    return jax.tree.map(lambda key: each(key, jnp.arange(draws)), keys), after


@functools.partial(jax.jit, static_argnums=2)
def sample_batch(key: jax.Array, views: Views | Windows, count: int | None) -> Batch:
    """Draw `count` pixels of photographs, or a whole photograph or window; consumes `key`."""
    if isinstance(views, Windows):
        return (
            sample_window(key, views) if count is None else sample_window_pixels(key, views, count)
        )
    return sample_image(key, views) if count is None else sample_pixels(key, views, count)


@functools.partial(jax.jit, static_argnums=2)
def sample_labels(
    key: jax.Array, labels: Views | Windows, count: int | None
) -> tuple[Batch, jax.Array]:
    """Draw `count` pixels of labeled views, or a whole one, and a key that renders them."""
    key_batch, key_render = jax.random.split(key)
    return sample_batch(key_batch, labels, count), key_render


class CloseupDraw(NamedTuple):
    """A virtual close-up, drawn at random.

    Attributes:
      camera: the virtual camera.
      source_index: `[]` int32, the photograph whose camera was moved.
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
    """Draw a virtual close-up and `count` of its pixels, or all of them; consumes `key`."""
    key_virtual, key_pixels, key_depth, key_render = jax.random.split(key, 4)
    camera, source_index = sample_virtual_camera(key_virtual, sources, settings)
    pixels = None
    if count is not None:
        size = jnp.array([[camera.width, camera.height]])
        pixels = jax.random.randint(key_pixels, (count, 2), 0, size).astype(jnp.float32) + 0.5
    return CloseupDraw(camera, source_index, pixels, key_depth, key_render)
