"""Detail: what photographs show beyond a model, added to its renders with calibrated weights.

The residual of a photograph is the photograph minus the model's render of its view. Gathered into
another view, it adds what the model did not learn, as far as it is really there: where photographs
disagree or depth is wrong, it is noise. Photographs that are left out tell how much of it is there.
A ridge regression on what is known of each pixel, and a monotone curve, learn to predict it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.optimize import isotonic_regression

from jaxcloseup.gather import DEFAULT, Gathered, GatherSettings, GatherSources, gather
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.numerics import matmul, safe_divide
from jaxcloseup.pyramids import Pyramid


# Interpolation and averaging take contrast: left-out photographs have up to twice the gathered
# residual where everything else is sure.
CONTRAST = 2.5
TENTHS = 10
_NEAREST, _FARTHEST = -1.0, 3.0  # log2 of how much finer views are than photographs can imitate
FEATURES = 14  # that tell how far to trust a residual
KNOTS = 12  # of the monotone curve, each with an equal share of the evidence
_RIDGE = 1e-2
FOLDS = 5


@struct.dataclass
class DetailWeights:
    """How features predict the share of a gathered residual that is really there.

    Attributes:
      coefficients: `[F]` of the ridge regression.
      regressed: `[K]` values of the regression, ascending.
      actual: `[K]` shares that left-out photographs have there, ascending.
    """

    coefficients: jax.Array
    regressed: jax.Array
    actual: jax.Array


@struct.dataclass
class Detail:
    """What a model's renders lack, as the photographs show it.

    Attributes:
      residuals: `[V, P, 3]` photograph minus render, finest level first.
      sources: the model's depth maps of the photographs.
      weights: how far to trust a gathered residual.
      finer: `[]` log2 of how much finer the finest level is than the photographs that the model
        learned from.
    """

    residuals: Pyramid
    sources: GatherSources
    weights: DetailWeights
    finer: jax.Array


class Detailed(NamedTuple):
    """An image with detail.

    Attributes:
      rgb: `[H, W, 3]` in [0, 1].
      weight: `[H, W]` in [0, 1], how far the photographs' detail is trusted.
      footprint: `[H, W]` side of the finest pixel that saw the surface, in pixels of the view;
        infinity where no photograph saw it.
    """

    rgb: jax.Array
    weight: jax.Array
    footprint: jax.Array


class Evidence(NamedTuple):
    """What a left-out photograph says about the residual gathered from the others, N pixels.

    Attributes:
      features: `[N, F]`.
      power: `[N]` square of the gathered residual, weighted.
      product: `[N]` its product with the photograph's own residual, weighted.
    """

    features: np.ndarray
    power: np.ndarray
    product: np.ndarray


def add_detail(
    detail: Detail,
    camera: Camera,
    pixels: jax.Array,
    rgb: jax.Array,
    alpha: jax.Array,
    depth: jax.Array,
    settings: GatherSettings = DEFAULT,
) -> Detailed:
    """Add what the photographs show beyond a render to its colors.

    Args:
      detail: of the state that was rendered.
      camera: camera of the render.
      pixels: `[H, W, 2]` its pixel centers, neighbors in the image.
      rgb: `[H, W, 3]` rendered colors.
      alpha: `[H, W]` rendered opacity.
      depth: `[H, W]` rendered z-depth; 0 is undefined and gets no detail.
      settings: how photographs are weighed.
    """
    found = gather(camera, pixels, depth, detail.sources, detail.residuals, settings)
    weight = predict(detail.weights, detail_features(found, alpha, depth, finer=detail.finer))
    weight = jnp.where(found.weight > 0, weight, 0)
    added = weight[..., None] * CONTRAST * found.mean
    # Photographs and view may differ in exposure, so detail keeps the mean color of the view.
    shift = safe_divide(jnp.sum(added, axis=(0, 1)), jnp.sum(weight))
    added = added - weight[..., None] * shift[None, None]
    return Detailed(jnp.clip(jnp.clip(rgb, 0, 1) + added, 0, 1), weight, found.footprint)


def detail_features(
    gathered: Gathered, alpha: jax.Array, depth: jax.Array, *, finer: jax.Array | float
) -> jax.Array:
    """What is known of each pixel's gathered residual, `[H, W, F]`, smooth in the camera.

    Args:
      gathered: residuals in a view `[H, W]`.
      alpha: `[H, W]` opacity of the view's render.
      depth: `[H, W]` its z-depth; 0 is undefined.
      finer: log2 of how much finer the photographs are than those that the model learned from.
    """
    energy = _blur(jnp.mean(gathered.mean**2, axis=-1))
    variance = _blur(gathered.variance)
    spread = safe_divide(variance, variance + energy, fill=1.0)
    # log2 of how much finer the view is than the model, and than the finest photographs.
    beyond_model = jnp.clip(finer - gathered.detail, _NEAREST, _FARTHEST)
    beyond_photographs = jnp.clip(-gathered.detail, 0, _FARTHEST)
    angle = jnp.minimum(gathered.angle, 0.6) / 0.2
    count = jnp.log2(1 + jnp.minimum(gathered.count, 31)) / 2
    features = (
        *(jnp.ones_like(spread), beyond_model, beyond_model**2, beyond_photographs),
        *(spread, spread**2, spread * beyond_model, spread * count),
        *(angle, angle * beyond_model, count, count * beyond_model),
        *(_edges(depth), alpha),
    )
    return jnp.stack(features, axis=-1)


def evidence(
    features: jax.Array, gathered: Gathered, residual: jax.Array, weight: jax.Array
) -> Evidence:
    """What one left-out photograph says.

    Args:
      features: `[..., F]` of its pixels.
      gathered: residuals gathered from the other photographs.
      residual: `[..., C]` its own residual.
      weight: `[...]` weight of its pixels.
    """
    mean = CONTRAST * gathered.mean
    power = weight * jnp.sum(mean**2, axis=-1)
    product = weight * jnp.sum(mean * residual, axis=-1)
    return Evidence(features.reshape(-1, features.shape[-1]), power.ravel(), product.ravel())


def learn_weights(photographs: Sequence[Sequence[Evidence]]) -> DetailWeights:
    """Ridge regression of the share that is really there, then a monotone curve through it.

    The share s minimizes the sum of |residual - s gathered|^2 over all pixels. The curve is the
    isotonic regression of the actual share on the regressed one, so that predictions mean what they
    say; each photograph's share is regressed from other photographs for it, since its own would
    look more certain than it is.

    Args:
      photographs: the evidence of each left-out photograph.
    """
    sums = [_normal_equations(found) for found in photographs]
    total = [sum(parts) for parts in zip(*sums, strict=True)]
    folds = min(FOLDS, len(photographs))
    columns = []
    for fold in range(folds):
        others = [parts for i, parts in enumerate(sums) if i % folds != fold] or sums
        coefficients = _regress(*(sum(parts) for parts in zip(*others, strict=True)))
        columns += [
            np.stack([one.features @ coefficients, one.power, one.product])
            for found in photographs[fold::folds]
            for one in found
        ]
    x, y = _monotone(*np.concatenate(columns, axis=1).astype(np.float64))
    return DetailWeights(*(jnp.asarray(array, jnp.float32) for array in (_regress(*total), x, y)))


def _normal_equations(found):
    count = found[0].features.shape[-1]
    squares, products = np.zeros((count, count)), np.zeros(count)
    for one in found:
        squares += (one.features * one.power[:, None]).T @ one.features
        products += one.features.T @ one.product
    return squares, products


def _regress(squares, products):
    scale = np.sqrt(np.diag(squares)) + 1e-12
    squares = squares / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
    return np.linalg.solve(squares, products / scale) / scale


def _monotone(regressed, power, product):
    """Knots `[K]` of the actual share, product / power, as a rising function of the regressed."""
    order = np.argsort(regressed, kind="stable")
    regressed, power, product = regressed[order], power[order], product[order]
    reached = np.cumsum(power)
    knot = np.minimum((reached / max(reached[-1], 1e-12) * KNOTS).astype(int), KNOTS - 1)
    mass, x, y = (np.bincount(knot, c, KNOTS) for c in (power, power * regressed, product))
    known = mass > 0
    if not known.any():
        return np.zeros(KNOTS), np.zeros(KNOTS)
    x, y = x[known] / mass[known], y[known] / mass[known]
    y = np.clip(isotonic_regression(y, weights=mass[known]).x, 0, 1)
    # Always as many knots, so that nothing recompiles.
    at, index = np.linspace(0, len(x) - 1, KNOTS), np.arange(len(x))
    return np.interp(at, index, x), np.interp(at, index, y)


def predict(weights: DetailWeights, features: jax.Array) -> jax.Array:
    """Predicted share `[...]` of a gathered residual that is really there, in [0, 1]."""
    regressed = matmul(features, weights.coefficients[:, None])[..., 0]
    return jnp.interp(regressed, weights.regressed, weights.actual)


def reliability(weights: DetailWeights, found: Sequence[Evidence]) -> np.ndarray:
    """Sums `[10, 4]` over the pixels of each tenth of the prediction.

    The columns sum the power, the power times the predicted share, and the product (the power times
    the actual share); the last one counts pixels.
    """
    sums = np.zeros((TENTHS, 4))
    for one in found:
        share = np.asarray(predict(weights, jnp.asarray(one.features)))
        tenth = np.minimum((share * TENTHS).astype(int), TENTHS - 1)
        columns = one.power, one.power * share, one.product, one.power > 0
        sums += np.stack([np.bincount(tenth, column, TENTHS) for column in columns], axis=1)
    return sums


def _blur(image):
    """Mean `[H, W]` over 5 x 5 pixels by binomial weights."""
    for axis in (0, 1):
        padded = jnp.pad(image, [(2, 2) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        size = image.shape[axis]
        image = sum(
            tap / 16 * jax.lax.slice_in_dim(padded, i, i + size, axis=axis)
            for i, tap in enumerate((1, 4, 6, 4, 1))
        )
    return image


def _edges(depth):
    """How sharply inverse depth `[H, W]` bends, in [0, 1]; 1 where depth is undefined."""
    inverse = safe_divide(jnp.ones_like(depth), depth)
    padded = jnp.pad(inverse, 1, mode="reflect")
    across = padded[1:-1, 2:] + padded[1:-1, :-2] - 2 * inverse
    down = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2 * inverse
    bend = safe_divide(jnp.maximum(jnp.abs(across), jnp.abs(down)), inverse, fill=1.0)
    return bend / (bend + 0.02)
