"""Train the weights of detail on close-ups whose true colors are known.

What a scene's own photographs predict of each other is too optimistic, because its depth is better
in their views than in close-ups. True close-ups of other scenes train the networks instead.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxcloseup.detail.add import Candidates
from jaxcloseup.detail.weights import WIDTHS, DetailWeights, Networks, mean_output, mix


PIXELS = 60_000  # training pixels of each scene and kind of view
_BATCH = 4096  # pixels
_FINEST = 0.5 / 255  # error of a color that is rounded to 8 bits


class Evidence(NamedTuple):
    """Inputs and targets of the networks for N pixels of a view whose true colors are known.

    Attributes:
      features: `[N, F]`.
      residual: `[N, 3]` gathered residual.
      colors: `[N, 3]` gathered colors minus the render; 0 where no photograph confirms the depth.
      missing: `[N, 3]` the truth minus the render.
      weight: `[N]` weight of its pixels.
    """

    features: Any
    residual: Any
    colors: Any
    missing: Any
    weight: Any


@jax.jit
def make_evidence(candidates: Candidates, missing: jax.Array, weight: jax.Array) -> Evidence:
    """Compute the networks' training inputs and targets from a view whose true colors are known.

    Args:
      candidates: gathered from the photographs; pixels that none of them saw weigh nothing.
      missing: `[H, W, 3]` the truth minus the render.
      weight: `[H, W]` weight of its pixels.
    """

    def rows(image: jax.Array) -> jax.Array:
        return image.reshape(-1, *image.shape[2:])

    return Evidence(
        features=rows(candidates.features),
        residual=rows(candidates.residual),
        colors=rows(candidates.colors),
        missing=rows(missing),
        weight=rows(jnp.where(candidates.weight > 0, weight, 0)),
    )


def learn_weights(
    scenes: Mapping[str, Sequence[Evidence]], *, steps: tuple[int, int] = (600, 1500)
) -> DetailWeights:
    """Train the networks to predict missing colors and their expected errors.

    A mixture g and its share s minimize |m - s g|^2 for the missing colors m, where every view has
    the same total weight. An expected error b minimizes log b + |m - s g| / b, whose least mean is
    at the mean error. Each network is trained without one of the scenes, in their order, and its
    expected errors are calibrated on scenes that the other networks never saw; a single scene
    trains one network.

    Args:
      scenes: the evidence of each scene's views.
      steps: steps of Adam for the mixture, and for expected errors.

    Raises:
      ValueError: no pixel is left to train one of the networks.
    """
    views = [(index, view) for index, views in enumerate(scenes.values()) for view in views]
    rows = jax.tree.map(lambda *arrays: np.concatenate(arrays), *(view for _, view in views))
    scene = np.concatenate([np.full(view.weight.shape, index) for index, view in views])
    importance = np.concatenate([_importance(view) for _, view in views])
    networks, tests = [], []
    for index, name in enumerate(scenes):
        chosen = (scene != index) | (len(scenes) == 1)
        if not np.any(rows.weight[chosen]):
            raise ValueError(f"no photograph shows anything of the scenes other than {name}.")
        weights, off = _train(rows, importance, chosen, steps)
        networks.append(weights)
        unseen = scene == index
        outputs = np.asarray(mean_output(weights.errors, rows.features[unseen]))
        tests.append((outputs, np.asarray(off[unseen])))
    for index, weights in enumerate(networks):
        others = [test for i, test in enumerate(tests) if i != index] or tests
        networks[index] = weights.replace(errors=_calibrated(weights.errors, others))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *networks)


def _train(
    rows: Evidence, importance: np.ndarray, chosen: np.ndarray, steps: tuple[int, int]
) -> tuple[DetailWeights, jax.Array]:
    """Train one network of each kind on chosen rows; return them and all rows' errors `[N, 2]`."""
    features = rows.features[chosen]
    start = _untrained(features.mean(0), 1 / (features.std(0) + 1e-3))
    descend = functools.partial(_descend, start, rows.features)
    targets = rows.residual, rows.colors, rows.missing
    mixing = descend(importance * chosen, targets, loss=_mixing_loss, steps=steps[0], rate=1e-2)
    mixed, share = mix(mean_output(mixing, rows.features), rows.residual, rows.colors)
    off = jnp.stack([rows.missing, rows.missing - share[:, None] * mixed], axis=1)
    off = jnp.maximum(jnp.mean(jnp.abs(off), axis=-1), _FINEST)
    errors = descend(rows.weight * chosen, (off,), loss=_error_loss, steps=steps[1], rate=5e-3)
    return DetailWeights(mixing, errors), off


def sample_evidence(evidence: Evidence, count: int, seed: int = 0) -> Evidence:
    """Draw at most `count` pixels of a view, of those with weight."""
    kept = np.flatnonzero(np.asarray(evidence.weight) > 0)
    kept = np.random.default_rng(seed).permutation(kept)[:count]
    return jax.tree.map(lambda array: np.asarray(array)[kept], evidence)


def _importance(view: Evidence) -> np.ndarray:
    """Return per-pixel weights `[N]` that give every view the same total weighted error.

    w_i N / sum_j w_j |m_j|^2, where m is what the render misses: views that the render already
    shows well would otherwise not count.
    """
    power = np.sum(view.weight[:, None] * view.missing**2)
    return (view.weight / max(power, 1e-12) * view.weight.size).astype(np.float32)


def _untrained(center: np.ndarray, scale: np.ndarray) -> Networks:
    """Return one random network whose outputs are small, so that shares begin near a half."""
    rng, layers = np.random.default_rng(0), list[Any]()
    for before, after in itertools.pairwise((len(scale), *WIDTHS)):
        size = np.sqrt(2 / before) * (0.1 if after == WIDTHS[-1] else 1)
        layers += [rng.normal(0, size, (1, before, after)), np.zeros((1, after))]
    floats = functools.partial(jnp.asarray, dtype=jnp.float32)
    return Networks(floats(center[None]), floats(scale[None]), tuple(map(floats, layers)))


def _calibrated(errors: Networks, tests: Sequence[tuple[np.ndarray, np.ndarray]]) -> Networks:
    """Return networks with outputs a + b o that minimize the loss on scenes they never saw.

    Trained networks are overconfident: they predict errors that are too small or too large.

    Args:
      errors: networks of expected errors, with outputs o.
      tests: outputs `[N, 2]` of other networks for unseen scenes, and the actual errors `[N, 2]`.
    """
    columns = map(np.concatenate, zip(*tests, strict=True))
    outputs, off = (column.astype(np.float64) for column in columns)
    *hidden, matrix, offset = errors.layers
    for index in range(WIDTHS[-1]):
        rows = np.stack([np.ones(len(off)), outputs[:, index]])
        change = np.array([0.0, 1.0])
        for _ in range(20):  # Newton steps; the loss is convex in a and b
            actual = off[:, index] * np.exp(-change @ rows)
            slope, bend = rows @ (1 - actual), (rows * actual) @ rows.T
            change -= np.linalg.solve(bend + 1e-9 * np.eye(2), slope)
        a, b = change
        matrix = matrix.at[..., index].multiply(b)
        offset = offset.at[..., index].set(a + b * offset[..., index])
    return errors.replace(layers=(*hidden, matrix, offset))


def _mixing_loss(
    outputs: jax.Array, residual: jax.Array, colors: jax.Array, missing: jax.Array
) -> jax.Array:
    mixed, share = mix(outputs, residual, colors)
    return jnp.sum((share[:, None] * mixed - missing) ** 2, axis=-1)


def _error_loss(outputs: jax.Array, off: jax.Array) -> jax.Array:
    return jnp.sum(outputs + off * jnp.exp(-outputs), axis=-1)


@functools.partial(jax.jit, static_argnames=("loss", "steps", "rate"))
def _descend(
    networks: Networks,
    features: jax.Array,
    counts: jax.Array,
    rows: Sequence[jax.Array],
    *,
    loss: Callable[..., jax.Array],
    steps: int,
    rate: float,
) -> Networks:
    """Minimize the mean `loss` of outputs and rows `[N, ...]` by Adam, with weights `counts`."""
    adam = optax.adam(optax.cosine_decay_schedule(rate, steps))
    counts = counts / jnp.mean(counts)

    def mean_loss(layers: Any, chosen: jax.Array) -> jax.Array:
        outputs = mean_output(networks.replace(layers=layers), features[chosen])
        return jnp.mean(counts[chosen] * loss(outputs, *(row[chosen] for row in rows)))

    def step(index: jax.Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        layers, moments = carry
        key = jax.random.fold_in(jax.random.key(0), index)
        chosen = jax.random.randint(key, (_BATCH,), 0, counts.shape[0])
        slope = jax.grad(mean_loss)(layers, chosen)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies by counts of steps
            change, moments = adam.update(slope, moments)
        return optax.apply_updates(layers, change), moments

    start = networks.layers, adam.init(networks.layers)
    return networks.replace(layers=jax.lax.fori_loop(0, steps, step, start)[0])
