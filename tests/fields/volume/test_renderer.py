"""The volume renderer on an analytic field, given only as a query function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.fields.volume.renderer import Samples, VolumeConfig, volume_field
from jaxcloseup.geometry.cameras import Camera


CENTER, SCALE = (0.2, -0.1, 3.0), 0.8  # the ball has radius 1 in field units
DENSITY = 1.5  # per world unit
CAMERA = Camera(jnp.eye(3, 4), jnp.array([9.0, 8, 4, 3]), height=6, width=8)


def ball(params, buffers, stage, key, positions, directions):
    """A ball of constant density; the fine pass colors it by the direction of view."""
    del buffers, key
    density = jnp.where(jnp.sum(positions**2, axis=0) < 1, params, 0.0)
    rgb = 0.5 + 0.5 * jnp.broadcast_to(directions.T[:, None], (*density.shape, 3))
    return Samples(density, rgb if stage == "fine" else jnp.full_like(rgb, 0.25))


def field(config=None, **changes):
    config = config or VolumeConfig(num_coarse=512, num_fine=512, background=0.5, chunk=20)
    parts = {"init": lambda *_: (DENSITY, ()), "query": ball} | changes
    return volume_field(config, Extent(0.5, 6.0, CENTER, SCALE), **parts)


def closed_form():
    """Alpha, mean depth, median depth and unit ray directions, `[H, W]`, in float64."""
    x, y = np.meshgrid(np.arange(8) + 0.5, np.arange(6) + 0.5)
    directions = np.stack([(x - 4) / 9, (y - 3) / 8, np.ones_like(x)], axis=-1)
    length = np.linalg.norm(directions, axis=-1)
    unit = directions / length[..., None]
    along = unit @ np.array(CENTER)
    half_squared = along**2 - np.sum(np.square(CENTER)) + 1 / SCALE**2
    half = np.sqrt(np.maximum(half_squared, 0))
    path = 2 * half
    alpha = 1 - np.exp(-DENSITY * path)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = along - half + 1 / DENSITY - path * (1 - alpha) / alpha
    median = np.where(alpha > 0.5, (along - half + np.log(2) / DENSITY) / length, 0)
    return alpha, np.where(alpha > 0, mean / length, 0), median, unit


def test_a_ball_has_its_closed_form_alpha_depth_and_color():
    seen = jax.jit(field().render)(DENSITY, (), CAMERA, None, None)
    alpha, mean, median, unit = closed_form()
    assert (alpha == 0).sum() > 5
    assert (alpha > 0.9).sum() > 5
    through = (alpha == 0) | (alpha > 0.2)  # a ray that grazes the ball has few samples in it
    for ours, expected in (
        (seen.alpha, alpha),
        (seen.depth, mean),
        (seen.aux.expected_depth, alpha * mean),
        (seen.rgb, alpha[..., None] * (0.5 + 0.5 * unit) + 0.5 * (1 - alpha[..., None])),
        (seen.aux.coarse_rgb, np.repeat(0.5 - 0.25 * alpha[..., None], 3, axis=-1)),
    ):
        np.testing.assert_allclose(np.asarray(ours)[through], expected[through], atol=0.02)
    decided = through & (np.abs(alpha - 0.5) > 0.02)
    np.testing.assert_allclose(
        np.asarray(seen.aux.median_depth)[decided], median[decided], atol=0.03
    )


def test_the_querys_key_is_none_without_a_key_and_differs_between_passes_and_chunks():
    def noise(params, buffers, stage, key, positions, directions):
        samples = ball(params, buffers, stage, None, positions, directions)
        if key is None:
            return samples
        return samples._replace(rgb=samples.rgb * 0 + jax.random.uniform(key))

    config = VolumeConfig(num_coarse=8, num_fine=8, chunk=24)  # two chunks
    render = jax.jit(field(config, query=noise).render)
    seen = render(1e6, (), CAMERA, None, jax.random.key(0))
    opaque = np.asarray(seen.alpha) > 0.999
    colors = [np.asarray(rgb)[..., 0] for rgb in (seen.rgb, seen.aux.coarse_rgb)]
    drawn = {
        round(float(v), 3) for c in colors for v in (c[:3][opaque[:3]][0], c[3:][opaque[3:]][0])
    }
    assert len(drawn) == 4
    plain = jax.jit(field(config).render)(DENSITY, (), CAMERA, None, None)
    silent = render(DENSITY, (), CAMERA, None, None)
    np.testing.assert_array_equal(silent.rgb, plain.rgb)


def test_the_field_differentiates_as_many_pixels_at_once_as_it_renders():
    assert field().gradient_chunk == 20
    assert field(VolumeConfig()).gradient_chunk is None


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 1.0)])
def test_an_empty_depth_range_is_refused(near, far):
    with pytest.raises(ValueError, match="near and far"):
        Extent(near, far)
