"""Compare the errors that detail expects with the actual ones."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.audit import error_curve
from jaxcloseup.app.score.targets import Target
from jaxcloseup.detail.add import Detailed
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.metrics.image_metrics import change_colors, fit_colors
from jaxcloseup.photos.views import to_float


TENTHS = 10


class PixelErrors(NamedTuple):
    """Errors of N pixels, mean absolute differences of colors in [0, 1]."""

    expected: np.ndarray  # `[N]`; NaN where nothing is expected
    actual: np.ndarray  # `[N]`
    weight: np.ndarray  # `[N]`, 0 where nothing is expected


def compare_errors(
    render: Callable[[Camera], Detailed], targets: Sequence[Target]
) -> dict[str, Any]:
    """Compare the expected error at each pixel of held-out views with the actual one.

    Args:
      render: `camera -> Detailed`.
      targets: the held-out views.

    Returns:
      `errors`, the rows of `error_tenths`, and what `rank_errors` says of all pixels: nothing, and
      no rows, without views.
    """

    def compare(target: Target) -> PixelErrors:
        return pixel_errors(render(target.camera), target.rgb, target.weight)

    views = list(progress.each(compare, targets, "expected errors"))
    if not views:
        return {"errors": []}
    expected, actual, weight = map(np.concatenate, zip(*views, strict=True))
    counts = weight > 0
    return {
        "errors": error_tenths(expected, actual, weight),
        **rank_errors(expected[counts], actual[counts]),
    }


def rank_errors(expected: np.ndarray, actual: np.ndarray) -> dict[str, float]:
    """Return how well expected errors tell where actual ones are large, by the field's measures.

    Args:
      expected: `[N]` expected errors.
      actual: `[N]` actual errors.

    Returns:
      `ause`, the area under the sparsification error (see `error_curve`): 0 if they sort pixels as
      their errors do. `pearson`, the coefficient of correlation. Nothing where all are the same.
    """
    curve = error_curve(expected, actual, len(expected))
    if curve is None or not np.ptp(expected) or not np.ptp(actual):
        return {}
    pearson = np.corrcoef(expected, actual)[0, 1]
    return {"ause": cast(float, curve["ause"]), "pearson": float(pearson)}


def pixel_errors(detailed: Detailed, truth: Any, weight: Any) -> PixelErrors:
    """Return expected and actual errors of the pixels of a view.

    An affine map first matches the view's colors to the photograph's, because the exposure of a
    photograph is unknown to the others. Pixels of small expected error weigh more in its fit.

    Args:
      detailed: the view with detail, as large as the photograph or padded.
      truth: `[H, W, 3]` colors of the photograph, uint8 or float.
      weight: `[H, W]` of its pixels; uint8 or float.
    """
    height, width = weight.shape
    rgb, error = detailed.rgb[:height, :width], detailed.error[:height, :width]
    truth, weight = (jnp.asarray(to_float(array)) for array in (truth, weight))
    weight = jnp.where(jnp.isfinite(error), weight, 0)
    change = fit_colors(rgb, truth, jnp.where(weight > 0, weight / error**2, 0))
    corrected = jnp.clip(change_colors(rgb, *change), 0, 1)
    actual = jnp.mean(jnp.abs(corrected - truth), axis=-1)
    return PixelErrors(*(np.asarray(values).ravel() for values in (error, actual, weight)))


def error_tenths(
    expected: np.ndarray, actual: np.ndarray, weight: np.ndarray
) -> list[dict[str, float]]:
    """Return mean `expected` and `actual` errors of each tenth of the pixels by expected error.

    Args:
      expected: `[N]` expected errors.
      actual: `[N]` actual errors.
      weight: `[N]` weight of each pixel; pixels of weight 0 do not count.
    """
    counts = weight > 0
    expected, actual, weight = expected[counts], actual[counts], weight[counts]
    order = np.argsort(expected, kind="stable")
    expected, actual, weight = expected[order], actual[order], weight[order].astype(np.float64)
    tenth = np.minimum(np.cumsum(weight) / max(weight.sum(), 1e-12) * TENTHS, TENTHS - 0.5)
    mass, of_expected, of_actual = (
        np.bincount(tenth.astype(int), weight * values, TENTHS) for values in (1, expected, actual)
    )
    return [
        {"expected": float(of_expected[i] / mass[i]), "actual": float(of_actual[i] / mass[i])}
        for i in np.flatnonzero(mass > 0)
    ]
