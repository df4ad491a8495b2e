"""Other programs' corrections of colors, against least squares in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.metrics.color_corrections import gsplat_cc_psnr, multinerf_cc_psnr
from jaxcloseup.metrics.image_metrics import psnr


@pytest.fixture(scope="module")
def pair():
    """An image whose colors are changed, clipped and noisy, its target, and weights of 0 and 1."""
    rng = np.random.default_rng(0)
    target = np.clip(rng.uniform(-0.1, 1.1, (30, 40, 3)) @ (0.6 * np.eye(3) + 0.13), 0, 1)
    image = 0.8 * target**1.3 + 0.05 + 0.02 * rng.standard_normal(target.shape)
    weight = rng.random((30, 40)) < 0.8
    return tuple(np.asarray(a, np.float32) for a in (np.clip(image, 0, 1), target, weight))


def psnr_of(image, target):
    return -10 * np.log10(np.mean((np.clip(image, 0, 1) - target) ** 2))


def test_affine_changes_of_channels(pair):
    image, target, weight = pair
    rows = [a[weight > 0].astype(np.float64) for a in (image, target)]
    fits = [np.polyfit(rows[1][:, c], rows[0][:, c], 1) for c in range(3)]
    slope, offset = np.array(fits).T
    expected = psnr_of((rows[0] - offset) / slope, rows[1])
    found = gsplat_cc_psnr(jnp.asarray(image), jnp.asarray(target), weight=jnp.asarray(weight))
    assert found == pytest.approx(expected, abs=1e-3)
    assert found > psnr(jnp.asarray(image), jnp.asarray(target), weight=jnp.asarray(weight)) + 3


def test_quadratic_changes_of_colors(pair):
    image, target, weight = pair
    colors, wanted = (a[weight > 0].astype(np.float64) for a in (image, target))

    def usable(values):
        return (values >= 0.5 / 255) & (values <= 1 - 0.5 / 255)

    first = usable(colors)
    for _ in range(5):
        r, g, b = colors.T
        rows = np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)], 1)
        counted = first & usable(colors) & usable(wanted)
        fits = [
            np.linalg.lstsq(rows[counted[:, c]], wanted[counted[:, c], c], rcond=None)[0]
            for c in range(3)
        ]
        colors = np.clip(rows @ np.stack(fits, 1), 0, 1)
    found = multinerf_cc_psnr(jnp.asarray(image), jnp.asarray(target), weight=jnp.asarray(weight))
    assert found == pytest.approx(psnr_of(colors, wanted), abs=0.01)


def test_images_of_one_color_have_a_score(pair):
    flat, target = jnp.full((30, 40, 3), 0.3), jnp.asarray(pair[1])
    weight = jnp.ones((30, 40))
    expected = psnr_of(pair[1].mean((0, 1)), pair[1])
    counted = np.isfinite([gsplat_cc_psnr(target, flat, weight=weight)])
    assert counted.all()
    assert multinerf_cc_psnr(flat, target, weight=weight) > expected - 1
