"""Upper bounds for labels: random virtual close-ups with true pixels, or with better depth."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxcloseup.app.score.footprints import resolved_by_photographs
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoSettings,
    label_sources,
    sample_virtual_camera,
)
from jaxcloseup.labels.target_views import label_views
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views, camera_at


CEILING_VIEWS = 64


def true_close_ups(
    key: jax.Array,
    scene: Scene,
    sources: LabelSources,
    exact: jax.Array,
    settings: PseudoSettings,
    *,
    blurred: bool,
) -> Views:
    """Render random virtual close-ups with their true pixels, where a training view sees them.

    This is an upper bound for labels, because no photograph has so much detail. `blurred` lowers
    the bound to the detail of the photograph with the smallest footprint.

    The scene has a `surface`; `exact` are `[V, H, W]` depths of the training views.

    Returns:
      `CEILING_VIEWS` close-ups; weight 0 where no photograph sees the surface.
    """
    sample, surface = jax.jit(sample_virtual_camera), scene.surface
    assert surface is not None
    images = []
    for key_view in jax.random.split(key, CEILING_VIEWS):
        camera, _ = sample(key_view, sources, settings)
        resolved, seen = resolved_by_photographs(scene, camera, exact)
        rgb = resolved if blurred else surface(camera).rgb
        images.append(Views(camera, jnp.asarray(rgb, jnp.float32), jnp.asarray(seen, jnp.float32)))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *images)


def labels_with_better_depth(
    key: jax.Array,
    scene: Scene,
    sources: LabelSources,
    exact: jax.Array,
    render_depths: Callable[[Camera], jax.Array],
    settings: PseudoSettings,
    *,
    share: float,
) -> Views:
    """Make labels for random virtual close-ups from depth with less error.

    They show what better geometry would bring.

    `render_depths` maps stacked cameras `[Q]` to their trained depths `[Q, H, W]`; `share` of the
    depth error remains: 1 is the trained depth, 0 the exact depth `[V, H, W]`.

    Returns:
      `CEILING_VIEWS` labeled close-ups.
    """

    def mix(trained: jax.Array, true: jax.Array) -> jax.Array:
        return jnp.where((trained > 0) & (true > 0), true + share * (trained - true), 0)

    sample, surface = jax.jit(sample_virtual_camera), scene.surface
    assert surface is not None
    keys = jax.random.split(key, CEILING_VIEWS)
    cameras = [sample(key_view, sources, settings)[0] for key_view in keys]
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    true = jnp.stack([surface(camera_at(cameras, i)).depth for i in range(CEILING_VIEWS)])
    targets, mixed = mix(render_depths(cameras), true), mix(sources.depths, exact)
    better = jax.jit(label_sources)(sources.views, mixed)
    return jax.jit(label_views)(cameras, targets, better, settings)
