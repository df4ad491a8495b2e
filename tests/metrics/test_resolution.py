"""The finest period resolved, against direct sums and images whose frequencies are known."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.metrics.resolution import (
    RINGS,
    SMALLEST,
    frequencies,
    resolved_period,
    ring_correlation,
)


LUMA = np.array([0.299, 0.587, 0.114])


def oracle(image, truth, weight, rings=RINGS):
    """Sum over all frequencies, by their definition, in float64."""
    height, width = truth.shape[:2]
    window = np.outer(np.hanning(height), np.hanning(width)) * weight
    down, right = np.meshgrid(np.fft.fftfreq(height), np.fft.fftfreq(width), indexing="ij")

    def spectrum(colors):
        gray = np.asarray(colors, np.float64) @ LUMA
        gray = (gray - np.average(gray, weights=window)) * window
        rows = np.exp(-2j * np.pi * np.outer(np.fft.fftfreq(height), np.arange(height)))
        columns = np.exp(-2j * np.pi * np.outer(np.arange(width), np.fft.fftfreq(width)))
        return rows @ gray @ columns

    ours, theirs = spectrum(image), spectrum(truth)
    found = np.zeros(rings)
    for ring in range(rings):
        inside = np.minimum(np.floor(np.hypot(down, right) * 2 * rings), rings - 1) == ring
        both = np.sum((ours * theirs.conj())[inside]).real
        power = np.sum(np.abs(ours[inside]) ** 2) * np.sum(np.abs(theirs[inside]) ** 2)
        found[ring] = both / np.sqrt(power)
    return found


def noise(seed, height, width):
    return np.random.default_rng(seed).uniform(0.2, 0.8, (height, width, 3)).astype(np.float32)


@pytest.mark.parametrize("size", [(81, 96), (120, 83)])
def test_rings_are_those_of_direct_sums(size):
    truth = noise(0, *size)
    image = 0.5 * truth + 0.5 * cv2.GaussianBlur(noise(1, *size), (0, 0), 1.5)
    weight = np.ones(size, np.float32)
    weight[:20, 30:] = 0
    found = jax.jit(ring_correlation)(image, truth, weight=weight)
    np.testing.assert_allclose(found, oracle(image, truth, weight), atol=2e-5)


def test_small_images_have_fewer_rings():
    truth = noise(0, 30, 41)
    image = 0.5 * truth + 0.5 * noise(1, 30, 41)
    fewer = oracle(image, truth, np.ones((30, 41)), rings=15)
    # The first ring, which says nothing, is not spread over more of them.
    expected = np.interp(frequencies(), frequencies(15)[1:], fewer[1:])
    np.testing.assert_allclose(ring_correlation(image, truth), expected, atol=2e-4)
    with pytest.raises(ValueError, match="16 pixels a side"):
        ring_correlation(image[: SMALLEST - 1], truth[: SMALLEST - 1])


@pytest.mark.parametrize("period", [5.0, 8.0, 12.5])
def test_what_is_finer_than_a_period_is_replaced(period):
    """All finer frequencies of the truth are exchanged, so the crossing is known."""
    truth, other = noise(2, 240, 320), noise(3, 240, 320)
    down, right = np.meshgrid(np.fft.fftfreq(240), np.fft.fftfreq(320), indexing="ij")
    coarse = (np.hypot(down, right) < 1 / period)[..., None]
    spectra = [np.fft.fft2(image, axes=(0, 1)) for image in (truth, other)]
    image = np.fft.ifft2(np.where(coarse, *spectra), axes=(0, 1)).real.astype(np.float32)
    found = resolved_period(np.asarray(ring_correlation(image, truth)))
    assert abs(1 / found - 1 / period) < 1 / (2 * RINGS)


def test_exposure_does_not_move_it():
    truth = noise(4, 100, 100)
    blurred = cv2.GaussianBlur(truth, (0, 0), 2) + 0.1 * noise(5, 100, 100)
    plain = ring_correlation(jnp.asarray(blurred), truth)
    darker = ring_correlation(jnp.asarray(0.6 * blurred + 0.1), truth)
    np.testing.assert_allclose(plain, darker, atol=1e-5)


def test_the_ends_of_the_scale():
    truth = noise(6, 64, 64)
    assert resolved_period(np.asarray(ring_correlation(truth, truth))) == 2
    nothing = np.asarray(ring_correlation(jnp.full_like(truth, 0.5), truth))
    np.testing.assert_allclose(nothing, 0, atol=1e-5)
    assert resolved_period(nothing) == np.inf
    first = np.where(np.arange(RINGS) < 1, 0.9, 0.1)  # the ring that does not count
    assert resolved_period(first) == resolved_period(np.full(RINGS, np.nan)) == np.inf
    line = 1 - np.arange(RINGS) / (RINGS - 1)
    period = resolved_period(line)
    assert np.interp(1 / period, frequencies(), line) == pytest.approx(0.5)
