"""Expected errors of renders with detail against their actual ones."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.scores import Target
from jaxcloseup.detail.add import Detailed
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors


TENTHS = 10


def compare_errors(
    render: Callable[[Camera], Detailed], targets: Sequence[Target]
) -> list[dict[str, float]]:
    """Compare the error that is expected at each pixel of held-out views with the actual one.

    An affine map first brings each view's colors to the photograph's, because no photograph knows
    the exposure of another one. Pixels tell it by how little error they expect.

    Args:
      render: `camera -> Detailed`.
      targets: the held-out views.

    Returns:
      The rows of `error_tenths`; none without views.
    """

    def compare(target):
        found, (height, width) = render(target.camera), target.weight.shape
        rgb, error = found.rgb[:height, :width], found.error[:height, :width]
        weight = jnp.where(jnp.isfinite(error), target.weight, 0)
        change = fit_colors(rgb, target.rgb, jnp.where(weight > 0, weight / error**2, 0))
        corrected = jnp.clip(change_colors(rgb, *change), 0, 1)
        actual = jnp.mean(jnp.abs(corrected - target.rgb), axis=-1)
        return [np.asarray(one).ravel() for one in (error, actual, weight)]

    found = list(progress.each(compare, targets, "expected errors"))
    return error_tenths(*map(np.concatenate, zip(*found, strict=True))) if found else []


def error_tenths(
    expected: np.ndarray, actual: np.ndarray, weight: np.ndarray
) -> list[dict[str, float]]:
    """Mean `expected` and `actual` errors of each tenth of the pixels, by what is expected.

    Args:
      expected: `[N]` expected errors.
      actual: `[N]` actual ones.
      weight: `[N]` weight of each pixel; those without any do not count.
    """
    counts = weight > 0
    expected, actual, weight = expected[counts], actual[counts], weight[counts]
    order = np.argsort(expected, kind="stable")
    expected, actual, weight = expected[order], actual[order], weight[order].astype(np.float64)
    tenth = np.minimum(np.cumsum(weight) / max(weight.sum(), 1e-12) * TENTHS, TENTHS - 0.5)
    mass, *sums = (
        np.bincount(tenth.astype(int), weight * one, TENTHS) for one in (1, expected, actual)
    )
    return [
        {"expected": float(guess / total), "actual": float(true / total)}
        for total, guess, true in zip(mass, *sums, strict=True)
        if total > 0
    ]
