"""Labels from depth with less error, on the plane z = 0, whose exact depth is known."""

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from tiny_runs import TINY

from jaxcloseup.app.sweep.ceilings import CEILING_VIEWS, labels_with_better_depth
from jaxcloseup.geometry.cameras import pixel_grid, pixels_to_rays
from jaxcloseup.labels.config import pseudo_settings
from jaxcloseup.labels.make import label_sources
from jaxcloseup.photos.scene import Scene, Surface
from jaxcloseup.photos.views import camera_at


OFF = 1.1  # trained depth over exact depth


def surface(camera):
    """Return the exact surface of the plane z = 0 with smooth colors."""
    origins, directions = pixels_to_rays(camera, pixel_grid(camera.height, camera.width))
    depth = -origins[..., 2] / directions[..., 2]
    points = origins + depth[..., None] * directions
    x, y = points[..., 0], points[..., 1]
    waves = jnp.stack([jnp.sin(2 * x), jnp.cos(3 * y), jnp.sin(x + 2 * y)], axis=-1)
    return Surface(0.5 + 0.4 * waves, depth, jnp.zeros_like(points))


def test_better_depth_makes_better_labels():
    cameras = [plane.camera_above(x, 0.1 * x, 4.0, tilt=0.1 * x) for x in (-1.0, 0.0, 1.0)]
    views, exact = plane.make_views(cameras)
    names, none = {"train": list("abc")}, np.zeros((0, 3))
    scene = Scene("plane", views, None, None, none, none, 0.5, 9.0, names, surface=surface)
    settings = pseudo_settings(TINY.labels).replace(
        use_mask=jnp.float32(0), depth_tolerance=jnp.float32(jnp.inf)
    )

    def trained(stacked):
        count = stacked.intrinsics.shape[0]
        return OFF * jnp.stack([surface(camera_at(stacked, i)).depth for i in range(count)])

    errors = {}
    for share in (0.0, 0.5, 1.0):
        sources = label_sources(views, OFF * exact)
        key = jax.random.key(0)
        labels = labels_with_better_depth(
            key, scene, sources, exact, trained, settings, share=share
        )
        assert len(labels) == CEILING_VIEWS
        truth = jnp.stack([surface(camera_at(labels.cameras, i)).rgb for i in range(CEILING_VIEWS)])
        difference = np.abs(labels.rgb - truth).mean(axis=-1)
        errors[share] = float((labels.weight * difference).sum() / labels.weight.sum())
    assert errors[0.0] < 0.01
    assert errors[0.0] < 0.5 * errors[0.5] < 0.4 * errors[1.0]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_undefined_depth_stays_undefined(share):
    views, exact = plane.make_views([plane.camera_above(0.0, 0.0, 4.0)])
    none = np.zeros((0, 3))
    scene = Scene(
        "plane", views, None, None, none, none, 0.5, 9.0, {"train": ["a"]}, surface=surface
    )
    nothing = jnp.zeros((CEILING_VIEWS, plane.HEIGHT, plane.WIDTH))
    labels = labels_with_better_depth(
        jax.random.key(0),
        scene,
        label_sources(views, exact),
        exact,
        lambda _: nothing,
        pseudo_settings(TINY.labels),
        share=share,
    )
    np.testing.assert_array_equal(labels.weight, 0)
