"""Weights of detail: small networks that predict how far gathered detail is really there.

Two predictions compete at each pixel: the gathered residual, which keeps the model's own render
where photographs show nothing, and gathered colors in place of the render, which need exact depth.
Where they agree with each other, and photographs among themselves, both are sharp; where depth is
wrong, they differ. One network maps a pixel's features to a mixture of the two and to the share of
it that is really there, a second one to the error of the colors that result. `detail.learn` trains
both.
"""

import functools
import io
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.numerics import matmul
from jaxcloseup.io.files import write_file


# Interpolation and averaging lose contrast: where everything else is sure, photographs have up to
# twice the gathered residual. The mixture can reach CONTRAST times it.
CONTRAST = 2.5
WIDTHS = 32, 32, 2  # units of each layer after the features
KNOWN = pathlib.Path(__file__).with_suffix(".npz")  # written by `experiments.benchmarks.teach`
_UNUSUAL = 2.5  # standard deviations; features farther from their mean are clipped to this


class Networks(struct.PyTreeNode):
    """K multilayer perceptrons of standardized features, with two outputs each.

    Attributes:
      center: `[K, F]` mean of the features.
      scale: `[K, F]` reciprocal of their standard deviation.
      layers: matrices `[K, A, B]` and offsets `[K, B]`, alternating.
    """

    center: jax.Array
    scale: jax.Array
    layers: tuple[jax.Array, ...]


class DetailWeights(struct.PyTreeNode):
    """Networks that predict what of a gathered residual and gathered colors is really there.

    Attributes:
      mixing: logits of the share of the mixture that is there, and of the colors' part in it.
      errors: logarithms of the expected error of the render, and of the render with detail.
    """

    mixing: Networks
    errors: Networks


def blend(
    weights: DetailWeights, features: jax.Array, residual: jax.Array, colors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mix a gathered residual and gathered colors.

    Args:
      weights: trained networks.
      features: `[..., F]` of each pixel.
      residual: `[..., 3]` gathered residual.
      colors: `[..., 3]` gathered colors minus the render.

    Returns:
      `[..., 3]` the mixture, and `[...]` the share of it that is really there, in [0, 1].
    """
    return mix(mean_output(weights.mixing, features), residual, colors)


def expected_errors(weights: DetailWeights, features: jax.Array) -> jax.Array:
    """Return the expected mean absolute error `[..., 2]` of colors in [0, 1].

    Args:
      weights: trained networks.
      features: `[..., F]` of each pixel.

    Returns:
      The error of the render, then that of the render with its share of the mixture.
    """
    return jnp.exp(mean_output(weights.errors, features))


def with_larger_errors(weights: DetailWeights, factor: float) -> DetailWeights:
    """Return weights that expect errors so many times as large."""
    *layers, offsets = weights.errors.layers
    errors = weights.errors.replace(layers=(*layers, offsets + math.log(factor)))
    return weights.replace(errors=errors)


def known_weights(unseen: str | None = None) -> DetailWeights:
    """Return the weights that come with the package, one network for each training scene.

    Args:
      unseen: name of a scene. If it is one of the training scenes, only the network that was
        trained without it is returned.
    """
    names, weights = _read_known()
    return one_network(weights, names.index(unseen)) if unseen in names else weights


def one_network(weights: DetailWeights, index: int) -> DetailWeights:
    """Return the single network that was trained without the scene of that index."""
    return jax.tree.map(lambda leaf: leaf[index : index + 1], weights)


@functools.cache
def _read_known() -> tuple[list[str], DetailWeights]:
    with np.load(KNOWN) as kept:
        arrays = {name: jnp.asarray(kept[name]) for name in kept if name != "names"}
        names = kept["names"].tolist()

    def networks(kind: str) -> Networks:
        layers = tuple(arrays[f"{kind}_layer_{i}"] for i in range(2 * len(WIDTHS)))
        return Networks(arrays[f"{kind}_center"], arrays[f"{kind}_scale"], layers)

    return names, DetailWeights(networks("mixing"), networks("errors"))


def write_known(path: pathlib.Path, names: Sequence[str], weights: DetailWeights) -> None:
    """Write weights as `known_weights` reads them, with the names of their training scenes."""
    arrays: dict[str, Any] = {"names": np.array(names)}
    for kind in ("mixing", "errors"):
        networks = getattr(weights, kind)
        arrays |= {f"{kind}_center": networks.center, f"{kind}_scale": networks.scale}
        arrays |= {f"{kind}_layer_{i}": layer for i, layer in enumerate(networks.layers)}
    file = io.BytesIO()
    np.savez(file, **arrays)
    write_file(path, file.getvalue())


def mean_output(networks: Networks, features: jax.Array) -> jax.Array:
    """Return the mean of all networks' outputs `[..., 2]` for features `[..., F]`."""
    rows = features.reshape(-1, features.shape[-1])
    count = networks.center.shape[0]
    each = (jax.tree.map(lambda leaf, i=i: leaf[i], networks) for i in range(count))
    outputs: Any = sum(_perceptron(network, rows) for network in each) / count
    return outputs.reshape(*features.shape[:-1], 2)


def _perceptron(network: Networks, features: jax.Array) -> jax.Array:
    values = (features - network.center[None]) * network.scale[None]
    values = jnp.clip(values, -_UNUSUAL, _UNUSUAL)
    *hidden, last = zip(network.layers[::2], network.layers[1::2], strict=True)
    for matrix, offset in hidden:
        values = jax.nn.relu(matmul(values, matrix) + offset[None])
    return matmul(values, last[0]) + last[1][None]


def mean_planes(networks: Networks, features: jax.Array) -> jax.Array:
    """Return the mean of all networks' outputs `[2, N]` for features `[F, N]`.

    On a CPU, this takes a third less time than `mean_output` if N is about 1000.
    """
    count = networks.center.shape[0]
    outputs: Any = 0
    for i in range(count):
        center, scale, *layers = (
            leaf[i] for leaf in (networks.center, networks.scale, *networks.layers)
        )
        values = jnp.clip((features - center[:, None]) * scale[:, None], -_UNUSUAL, _UNUSUAL)
        for matrix, offset in zip(layers[:-2:2], layers[1:-2:2], strict=True):
            values = jax.nn.relu(matmul(matrix.T, values) + offset[:, None])
        outputs += matmul(layers[-2].T, values) + layers[-1][:, None]
    return outputs / count


def mix(outputs: jax.Array, residual: jax.Array, colors: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the mixture `[..., 3]` and its share `[...]` for outputs of the mixing networks."""
    share, mixture = jax.nn.sigmoid(outputs[..., 0]), jax.nn.sigmoid(outputs[..., 1:])
    return (1 - mixture) * CONTRAST * residual + mixture * colors, share
