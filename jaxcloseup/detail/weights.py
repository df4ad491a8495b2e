"""How far gathered detail is really there: small networks that close-ups of known scenes teach.

Two predictions compete at each pixel: the gathered residual, which keeps the model's own render
where photographs say nothing, and gathered colors in place of the render, which need exact depth.
Where they agree with each other, and photographs among themselves, both are sharp; where depth is
wrong, they differ. A network of a pixel's features mixes them, and says which share of the mixture
is really there. A second one says by how much colors are off in the end.

True close-ups of other scenes teach both: what a scene's own photographs would say of each other
is too hopeful, because its depth is better in their views than in close-ups.
"""

import functools
import io
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.io.files import write_file


# Interpolation and averaging take contrast: photographs have up to twice the gathered residual
# where everything else is sure.
CONTRAST = 2.5
WIDTHS = 32, 32, 2  # units of each layer after the features
PIXELS = 60_000  # of each scene and kind of view that teach the networks
KNOWN = pathlib.Path(__file__).with_suffix(".npz")  # what `experiments.teach` learned
_BATCH = 4096  # pixels
_UNUSUAL = 2.5  # standard deviations beyond which features count as no more unusual
_FINEST = 0.5 / 255  # error of a color that is rounded to 8 bits


class Evidence(NamedTuple):
    """What a true view says about what is gathered for it, N pixels.

    Attributes:
      features: `[N, F]`.
      residual: `[N, 3]` gathered residual.
      colors: `[N, 3]` gathered colors minus the render; 0 where no photograph confirms the depth.
      own: `[N, 3]` the truth minus the render.
      weight: `[N]` weight of its pixels.
    """

    features: np.ndarray
    residual: np.ndarray
    colors: np.ndarray
    own: np.ndarray
    weight: np.ndarray


class Networks(struct.PyTreeNode):
    """K networks of features.

    Attributes:
      center: `[K, F]` mean of the features.
      scale: `[K, F]` 1 / their standard deviation.
      layers: matrices `[K, A, B]` and offsets `[K, B]`, alternating, from the features to two
        outputs.
    """

    center: jax.Array
    scale: jax.Array
    layers: tuple[jax.Array, ...]


class DetailWeights(struct.PyTreeNode):
    """How features predict what of a gathered residual and colors is really there.

    Attributes:
      mixing: networks that say which share of the mixture is there, and what the mixture is.
      errors: networks that say how far the render is off, and the render with what is added.
    """

    mixing: Networks
    errors: Networks


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
      `[..., 3]` the mixture, and `[...]` the share of it that is really there, in [0, 1].
    """
    return _mix(_mean_output(weights.mixing, features), residual, colors)


def expected_errors(weights: DetailWeights, features: jax.Array) -> jax.Array:
    """The mean absolute error of colors in [0, 1] that features `[..., F]` let expect, `[..., 2]`.

    The first is that of the render, the second that of the render with its share of the mixture.
    """
    return jnp.exp(_mean_output(weights.errors, features))


def known_weights(unseen: str | None = None) -> DetailWeights:
    """The weights that come with the package: as many networks as scenes taught them.

    Args:
      unseen: name of a scene: if it is one of them, the network that never saw it speaks alone.
    """
    names, weights = _read_known()
    return one_network(weights, names.index(unseen)) if unseen in names else weights


def one_network(weights: DetailWeights, index: int) -> DetailWeights:
    """The weights of a single network: the one that never saw the scene of that index."""
    return jax.tree.map(lambda leaf: leaf[index : index + 1], weights)


@functools.cache
def _read_known():
    with np.load(KNOWN) as kept:
        arrays = {name: jnp.asarray(kept[name]) for name in kept if name != "names"}
        names = kept["names"].tolist()

    def networks(kind):
        layers = (arrays[f"{kind}_layer_{i}"] for i in range(2 * len(WIDTHS)))
        return Networks(arrays[f"{kind}_center"], arrays[f"{kind}_scale"], tuple(layers))

    return names, DetailWeights(networks("mixing"), networks("errors"))


def write_known(path: pathlib.Path, names: Sequence[str], weights: DetailWeights) -> None:
    """Write weights as `known_weights` reads them, with the names of their scenes."""
    arrays = {"names": np.array(names)}
    for kind in ("mixing", "errors"):
        found = getattr(weights, kind)
        arrays |= {f"{kind}_center": found.center, f"{kind}_scale": found.scale}
        arrays |= {f"{kind}_layer_{i}": layer for i, layer in enumerate(found.layers)}
    file = io.BytesIO()
    np.savez(file, **arrays)
    write_file(path, file.getvalue())


def learn_weights(
    scenes: Mapping[str, Sequence[Evidence]], *, steps: tuple[int, int] = (600, 1500)
) -> DetailWeights:
    """Teach the networks what is really there, and how far colors are off.

    A mixture g and its share s minimize |own - s g|^2, where every view counts alike, whatever its
    error. An expected error b minimizes log b + |own - s g| / b, whose least mean is at the mean
    error; its logarithm then suits what others say of scenes that they never saw. Each network is
    taught without one of the scenes, in their order; a single scene teaches one network.

    Args:
      scenes: the evidence of each scene's views.
      steps: of Adam that teach the mixture, and expected errors.

    Raises:
      ValueError: nothing teaches one of the networks.
    """
    views = [(index, view) for index, views in enumerate(scenes.values()) for view in views]
    found = jax.tree.map(lambda *arrays: np.concatenate(arrays), *(view for _, view in views))
    scene = np.concatenate([np.full(view.weight.shape, index) for index, view in views])
    importance = np.concatenate([_importance(view) for _, view in views])
    networks, tests = [], []
    for index, name in enumerate(scenes):
        taught = (scene != index) | (len(scenes) == 1)
        if not np.any(found.weight[taught]):
            raise ValueError(f"no photograph shows anything of the scenes other than {name}.")
        features = found.features[taught]
        start = _untaught(features.mean(0), 1 / (features.std(0) + 1e-3))
        rows = found.residual, found.colors, found.own
        teach = functools.partial(_descend, start, found.features)
        mixing = teach(importance * taught, rows, loss=_mixing_loss, steps=steps[0], rate=1e-2)
        mixed, share = _mix(_mean_output(mixing, found.features), *rows[:2])
        off = jnp.stack([found.own, found.own - share[:, None] * mixed], axis=1)
        off = jnp.maximum(jnp.mean(jnp.abs(off), axis=-1), _FINEST)
        errors = teach(found.weight * taught, (off,), loss=_error_loss, steps=steps[1], rate=5e-3)
        networks.append(DetailWeights(mixing, errors))
        own = scene == index
        tests.append((np.asarray(_mean_output(errors, found.features[own])), np.asarray(off[own])))
    for index, one in enumerate(networks):
        others = [test for i, test in enumerate(tests) if i != index] or tests
        networks[index] = one.replace(errors=_calibrated(one.errors, others))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *networks)


def sample_evidence(evidence: Evidence, count: int, seed: int = 0) -> Evidence:
    """At most `count` pixels of a view, those with weight."""
    kept = np.flatnonzero(np.asarray(evidence.weight) > 0)
    kept = np.random.default_rng(seed).permutation(kept)[:count]
    return jax.tree.map(lambda rows: np.asarray(rows)[kept], evidence)


def _importance(view):
    """How much each pixel of a view counts, `[N]`: as much as others if the view is as wrong."""
    power = np.sum(view.weight[:, None] * view.own**2)
    return (view.weight / max(power, 1e-12) * view.weight.size).astype(np.float32)


def _untaught(center, scale):
    """One network of standardized features; its outputs are small, so shares begin near a half."""
    rng, layers = np.random.default_rng(0), []
    for before, after in itertools.pairwise((len(scale), *WIDTHS)):
        size = np.sqrt(2 / before) * (0.1 if after == WIDTHS[-1] else 1)
        layers += [rng.normal(0, size, (1, before, after)), np.zeros((1, after))]
    arrays = Networks(center[None], scale[None], tuple(layers))
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), arrays)


def _calibrated(errors, tests):
    """Networks with outputs a + b o, where a and b suit what others say of scenes they never saw.

    Networks are too sure: errors that seem very small or very large to them are less so elsewhere.
    """
    columns = map(np.concatenate, zip(*tests, strict=True))
    outputs, off = (column.astype(np.float64) for column in columns)
    *hidden, matrix, offset = errors.layers
    for index in range(WIDTHS[-1]):
        rows = np.stack([np.ones(len(off)), outputs[:, index]])
        change = np.array([0.0, 1.0])
        for _ in range(20):  # Newton's steps; the loss is convex
            actual = off[:, index] * np.exp(-change @ rows)
            slope, bend = rows @ (1 - actual), (rows * actual) @ rows.T
            change -= np.linalg.solve(bend + 1e-9 * np.eye(2), slope)
        a, b = change
        matrix = matrix.at[..., index].multiply(b)
        offset = offset.at[..., index].set(a + b * offset[..., index])
    return errors.replace(layers=(*hidden, matrix, offset))


def _mean_output(networks, features):
    """What networks say of features `[..., F]` in the mean, `[..., 2]`."""
    rows = features.reshape(-1, features.shape[-1])
    count = networks.center.shape[0]
    each = (jax.tree.map(lambda leaf, i=i: leaf[i], networks) for i in range(count))
    outputs = sum(_perceive(one, rows) for one in each) / count
    return outputs.reshape(*features.shape[:-1], 2)


def _perceive(network, features):
    values = (features - network.center[None]) * network.scale[None]
    values = jnp.clip(values, -_UNUSUAL, _UNUSUAL)
    *hidden, last = zip(network.layers[::2], network.layers[1::2], strict=True)
    for matrix, offset in hidden:
        values = jax.nn.relu(matmul(values, matrix) + offset[None])
    return matmul(values, last[0]) + last[1][None]


def _mix(outputs, residual, colors):
    share, mixture = jax.nn.sigmoid(outputs[..., 0]), jax.nn.sigmoid(outputs[..., 1:])
    return (1 - mixture) * CONTRAST * residual + mixture * colors, share


def _mixing_loss(outputs, residual, colors, own):
    mixed, share = _mix(outputs, residual, colors)
    return jnp.sum((share[:, None] * mixed - own) ** 2, axis=-1)


def _error_loss(outputs, off):
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
    """Networks whose mean `loss` of outputs and rows `[N, ...]` is small, by Adam."""
    adam = optax.adam(optax.cosine_decay_schedule(rate, steps))
    counts = counts / jnp.mean(counts)

    def mean_loss(layers, chosen):
        outputs = _mean_output(networks.replace(layers=layers), features[chosen])
        return jnp.mean(counts[chosen] * loss(outputs, *(row[chosen] for row in rows)))

    def step(index, so_far):
        layers, moments = so_far
        key = jax.random.fold_in(jax.random.key(0), index)
        chosen = jax.random.randint(key, (_BATCH,), 0, counts.shape[0])
        slope = jax.grad(mean_loss)(layers, chosen)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies by counts of steps
            change, moments = adam.update(slope, moments)
        return optax.apply_updates(layers, change), moments

    start = networks.layers, adam.init(networks.layers)
    return networks.replace(layers=jax.lax.fori_loop(0, steps, step, start)[0])
