"""The finest structure that an image resolves, by Fourier ring correlation.

M. van Heel and M. Schatz, "Fourier shell correlation threshold criteria", 2005: two images of one
thing are correlated over rings of equal frequency. Exposure and white balance do not move the
correlation, noise and blur do not raise it, and where it falls below a half, what an image shows
is no longer mostly what is there.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.metrics.image_metrics import in_single


RINGS = 40  # rings of equal width up to the finest frequency, half a period for each pixel
SMALLEST = 16  # pixels a side: below, a ring holds too few frequencies
THRESHOLD = 0.5
_LUMA = (0.299, 0.587, 0.114)


def ring_correlation(
    image: jax.Array, truth: jax.Array, *, weight: jax.Array | None = None
) -> jax.Array:
    """Compute how an image's brightness correlates with the truth at each of `RINGS` frequencies.

    Ring k has the frequencies around (k + 1/2) / 80 periods for each pixel. Images are faded to
    their mean towards their border by a Hann window, which no frequency of the border survives;
    those smaller than 80 pixels have fewer rings, between which the result is interpolated.

    Args:
      image: `[H, W, 3]` in [0, 1], at least `SMALLEST` pixels a side.
      truth: `[H, W, 3]` in [0, 1].
      weight: `[H, W]` weight of each pixel; 1 by default.

    Returns:
      `[RINGS]` in [-1, 1]; 0 where an image has nothing of a frequency.

    Raises:
      ValueError: a side of the image has fewer than `SMALLEST` pixels.
    """
    image, truth, weight = in_single(image, truth, weight)
    height, width = image.shape[:2]
    if min(height, width) < SMALLEST:
        raise ValueError(
            f"ring correlation needs {SMALLEST} pixels a side: the image is {height, width}."
        )
    window = jnp.asarray(np.outer(np.hanning(height), np.hanning(width)), image.dtype)
    rings, which, times = _rings(height, width)
    found = _correlate(image, truth, window, weight, which, times, rings=rings)
    if rings == RINGS:
        return found
    # Their first ring says nothing of others: `resolved_period`.
    return jnp.interp(frequencies(), frequencies(rings)[1:], found[1:])


@functools.partial(jax.jit, static_argnames="rings")
def _correlate(
    image: jax.Array,
    truth: jax.Array,
    window: jax.Array,
    weight: jax.Array,
    which: jax.Array,
    times: jax.Array,
    *,
    rings: int,
) -> jax.Array:
    """Correlate over rings; what is as large as the image is an argument, not kept in a program."""
    window = window * weight
    luma = jnp.asarray(_LUMA, image.dtype)

    def spectrum(colors: jax.Array) -> jax.Array:
        gray = jnp.sum(colors * luma[None, None], axis=-1)
        for _ in range(2):  # the second time takes what rounding leaves
            gray = gray - safe_divide(jnp.sum(window * gray), jnp.sum(window))
        return jnp.fft.rfft2(gray * window)

    def over_rings(values: jax.Array) -> jax.Array:
        return jax.ops.segment_sum((values * times).reshape(-1), which, num_segments=rings)

    ours, theirs = spectrum(image), spectrum(truth)
    power = over_rings(jnp.abs(ours) ** 2), over_rings(jnp.abs(theirs) ** 2)
    both = over_rings((ours * jnp.conj(theirs)).real)
    return safe_divide(both, jnp.sqrt(power[0]) * jnp.sqrt(power[1]))


def _rings(height: int, width: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the number of rings, and of each frequency its ring and how often it counts."""
    rings = min(RINGS, min(height, width) // 2)
    down, right = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    # What is finer than half a period in a pixel, diagonally, belongs to the last ring.
    which = np.minimum((np.hypot(down, right) * 2 * rings).astype(np.int32), rings - 1)
    # Only half of a real image's frequencies are computed: each stands for its opposite too.
    times = np.where((right == 0) | (right == 0.5), 1, 2).astype(np.float32)
    return rings, which.reshape(-1), times


def frequencies(rings: int = RINGS) -> np.ndarray:
    """Return the rings' frequencies in periods for each pixel, `[rings]` rising."""
    return (np.arange(rings) + 0.5) / (2 * rings)


def resolved_period(correlation: np.ndarray) -> float:
    """Return the finest period, in pixels, up to which the correlation is at least a half.

    Args:
      correlation: `[RINGS]` from `ring_correlation`, of one image or the mean of several.

    Returns:
      2 where every frequency is resolved, infinity where none is, or where the correlation is not
      known. The first ring, which the window blurs into the mean, does not count.
    """
    below = np.flatnonzero(~(np.asarray(correlation)[1:] >= THRESHOLD)) + 1
    if not len(below):
        return 2.0
    after, centers = int(below[0]), frequencies(len(correlation))
    before = after - 1
    if before == 0 or not np.isfinite(correlation[after]):
        return float("inf")
    share = (correlation[before] - THRESHOLD) / (correlation[before] - correlation[after])
    return float(1 / (centers[before] + share * (centers[after] - centers[before])))
