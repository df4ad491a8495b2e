"""How far gathered detail is really there: small networks that left-out photographs teach.

Two predictions compete at each pixel: the gathered residual, which keeps the model's own render
where photographs say nothing, and gathered colors in place of the render, which need exact depth.
Where they agree with each other, and photographs among themselves, both are sharp; where depth is
wrong, they differ. A network of a pixel's features mixes them, and says which share of the mixture
is really there. A monotone curve then makes that share mean what it says.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from scipy.optimize import isotonic_regression

from jaxcloseup.numerics import matmul


# Interpolation and averaging take contrast: left-out photographs have up to twice the gathered
# residual where everything else is sure.
CONTRAST = 2.5
TENTHS = 10
FOLDS = 5  # and as many networks, each taught without one fold of the photographs
WIDTHS = 32, 32, 2  # units of each layer after the features
KNOTS = 32  # of the monotone curve, each with an equal share of the evidence
PIXELS = 600_000  # that teach the networks
_STEPS, _BATCH, _RATE = 600, 4096, 1e-2
_UNUSUAL = 2.5  # standard deviations beyond which features count as no more unusual


class Evidence(NamedTuple):
    """What a left-out photograph says about what is gathered from the others, N pixels.

    Attributes:
      features: `[N, F]`.
      residual: `[N, 3]` gathered residual.
      colors: `[N, 3]` gathered colors minus the render; 0 where no photograph confirms the depth.
      own: `[N, 3]` the photograph's own residual.
      weight: `[N]` weight of its pixels.
    """

    features: np.ndarray
    residual: np.ndarray
    colors: np.ndarray
    own: np.ndarray
    weight: np.ndarray


@struct.dataclass
class DetailWeights:
    """How features predict what of a gathered residual and colors is really there, K networks.

    Attributes:
      center: `[F]` mean of the features.
      scale: `[F]` 1 / their standard deviation.
      layers: matrices `[K, A, B]` and offsets `[K, B]`, alternating, from the features to two
        outputs.
      share: `[P]` shares as the networks predict them, ascending.
      actual: `[P]` shares that left-out photographs have there, ascending; below 0 where the
        mixture points away from the truth.
    """

    center: jax.Array
    scale: jax.Array
    layers: tuple[jax.Array, ...]
    share: jax.Array
    actual: jax.Array


def blend(
    weights: DetailWeights, features: jax.Array, residual: jax.Array, colors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mix a gathered residual and gathered colors.

    Args:
      weights: that were learned.
      features: `[..., F]` of each pixel.
      residual: `[..., 3]` gathered residual.
      colors: `[..., 3]` gathered colors minus the render.

    Returns:
      `[..., 3]` the mixture, and `[...]` the share of it that is really there, in [0, 1]; 0 too
      where a share below 0 is predicted.
    """
    outputs = sum(_outputs(weights, features)) / weights.layers[0].shape[0]
    mixed, share = _mix(outputs, residual, colors)
    return mixed, jnp.interp(share, weights.share, jnp.maximum(weights.actual, 0))


def learn_weights(
    photographs: Sequence[Sequence[Evidence]],
) -> tuple[DetailWeights, np.ndarray]:
    """Teach the networks what is really there, then the curve of shares.

    A mixture g and its share s minimize the sum of |own - s g|^2 over all pixels. Each network is
    taught without one fold of the photographs, and what it says of that fold makes the curve, by
    isotonic regression: what it says of its teachers would look more certain than it is.

    Args:
      photographs: the evidence of each left-out photograph.

    Returns:
      The weights, and sums `[10, 4]` over the pixels of each tenth of the predicted share: of the
      power |g|^2, of the power times that share, of the product of g with the photograph's own
      residual (the power times the actual share), and the number of pixels. Each fold is predicted
      by the network and the curve of the others. The first tenth holds what is below 0, too.
    """
    found, fold = _sample(photographs)
    folds = int(fold.max()) + 1
    center, deviation = found.features.mean(0), found.features.std(0)
    scale = 1 / (deviation + 1e-3)
    layers = _first_layers(len(center), folds)
    weights = DetailWeights(*map(jnp.asarray, (center, scale)), layers, None, None)
    counts = np.ones((folds, len(fold)), np.float32)
    if folds > 1:
        counts = (np.arange(folds)[:, None] != fold).astype(np.float32)
    weights = weights.replace(layers=_train(weights, found, counts * found.weight))

    columns = []
    for index, (mixed, share) in enumerate(jax.device_get(_predictions(weights, found))):
        power = found.weight * np.sum(mixed**2, axis=-1)
        product = found.weight * np.sum(mixed * found.own, axis=-1)
        columns.append(np.stack([share, power, product])[:, fold == index].astype(np.float64))
    sums = np.zeros((TENTHS, 4))
    for index, own in enumerate(columns):
        others = [one for i, one in enumerate(columns) if i != index] or columns
        share = np.interp(own[0], *_monotone(*np.concatenate(others, axis=1)))
        sums += _by_tenths(share, *own[1:])
    curve = _monotone(*np.concatenate(columns, axis=1))
    x, y = (jnp.asarray(array, jnp.float32) for array in curve)
    return weights.replace(share=x, actual=y), sums


def _sample(photographs):
    """Pixels of all photographs, at most `PIXELS`, as one `Evidence`; and their folds `[N]`."""
    folds = min(FOLDS, len(photographs))
    total = sum(one.weight.size for found in photographs for one in found)
    rng = np.random.default_rng(0)
    parts, fold = [], []
    for index, found in enumerate(photographs):
        for one in found:
            kept = np.flatnonzero(rng.random(one.weight.size) * total < PIXELS)
            parts.append(jax.tree.map(lambda array, kept=kept: array[kept], one))
            fold.append(np.full(len(kept), index % folds))
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts), np.concatenate(fold)


def _first_layers(features, count):
    rng, layers = np.random.default_rng(0), []
    for before, after in itertools.pairwise((features, *WIDTHS)):
        # Small outputs, so that shares begin near one half.
        size = np.sqrt(2 / before) * (0.1 if after == 2 else 1)
        layers.append(jnp.asarray(rng.normal(0, size, (count, before, after)), jnp.float32))
        layers.append(jnp.zeros((count, after)))
    return tuple(layers)


def _outputs(weights, features):
    """What each network says of features `[..., F]`, one after the other: `[..., 2]`."""
    shape = features.shape[:-1]
    usual = _usual(weights, features.reshape(-1, features.shape[-1]))
    for layers in zip(*weights.layers, strict=True):
        yield _perceive(layers, usual).reshape(*shape, 2)


@jax.jit
def _predictions(weights, found):
    """The mixture and its share as each network has them, one after the other."""
    outputs = _outputs(weights, found.features)
    return tuple(_mix(own, found.residual, found.colors) for own in outputs)


@jax.jit
def _usual(weights, features):
    usual = (features - weights.center[None]) * weights.scale[None]
    return jnp.clip(usual, -_UNUSUAL, _UNUSUAL)


def _perceive(layers, values):
    *hidden, last = zip(layers[::2], layers[1::2], strict=True)
    for matrix, offset in hidden:
        values = jax.nn.relu(matmul(values, matrix) + offset[None])
    return matmul(values, last[0]) + last[1][None]


def _mix(outputs, residual, colors):
    share, mixture = jax.nn.sigmoid(outputs[..., 0]), jax.nn.sigmoid(outputs[..., 1:])
    return (1 - mixture) * CONTRAST * residual + mixture * colors, share


def _train(weights, found, counts):
    """Layers that predict the photographs' own residuals, by Adam; pixels count `[K, N]`."""
    typical = max(float(np.mean(found.weight[:, None] * found.own**2)), 1e-12)
    data = *(jnp.asarray(array) for array in (found.residual, found.colors, found.own)), typical
    return _descend(weights.layers, _usual(weights, found.features), jnp.asarray(counts), data)


@jax.jit
def _descend(layers, features, counts, data):
    residual, colors, own, typical = data
    adam = optax.adam(optax.cosine_decay_schedule(_RATE, _STEPS))

    def loss(layers, count, chosen):
        outputs = _perceive(layers, features[chosen])
        mixed, share = _mix(outputs, residual[chosen], colors[chosen])
        error = share[:, None] * mixed - own[chosen]
        return jnp.mean(count[chosen][:, None] * error**2) / typical

    def step(index, so_far):
        layers, moments = so_far
        key = jax.random.fold_in(jax.random.key(0), index)
        chosen = jax.random.randint(key, (_BATCH,), 0, features.shape[0])
        slope = jax.vmap(functools.partial(jax.grad(loss), chosen=chosen))(layers, counts)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies by counts of steps
            change, moments = adam.update(slope, moments)
        return optax.apply_updates(layers, change), moments

    return jax.lax.fori_loop(0, _STEPS, step, (layers, adam.init(layers)))[0]


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
    y = np.clip(isotonic_regression(y, weights=mass[known]).x, -1, 1)
    # Always as many knots, so that nothing recompiles.
    at, index = np.linspace(0, len(x) - 1, KNOTS), np.arange(len(x))
    return np.interp(at, index, x), np.interp(at, index, y)


def _by_tenths(share, power, product):
    tenth = np.clip((share * TENTHS).astype(int), 0, TENTHS - 1)
    columns = power, power * share, product, power > 0
    return np.stack([np.bincount(tenth, column, TENTHS) for column in columns], axis=1)
