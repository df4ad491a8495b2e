"""The network of a NeRF, features first: activations are `[features, samples]`.

Samples are the long axis of every product, and being last they are contiguous, forward and
backward. A layer may have several inputs: it holds one matrix for each instead of concatenating.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


Params = Any


class Features(NamedTuple):
    """What the network says of samples, before activation: density `[M]`, rgb `[3, M]`."""

    density: jax.Array
    rgb: jax.Array


def init_dense(key: jax.Array, fan_ins: Sequence[int], fan_out: int) -> Params:
    """A layer with Glorot-uniform weights `[fan_out, fan_in]` for each input, and zero bias."""
    limit = (6 / (sum(fan_ins) + fan_out)) ** 0.5
    keys = jax.random.split(key, len(fan_ins))
    weights = tuple(
        jax.random.uniform(k, (fan_out, fan_in), minval=-limit, maxval=limit)
        for k, fan_in in zip(keys, fan_ins, strict=True)
    )
    return {"weights": weights, "bias": jnp.zeros(fan_out)}


def dense(layer: Params, *inputs: jax.Array) -> jax.Array:
    """`sum_i W_i x_i + b`, in the parameters' dtype whatever the inputs' dtype."""
    return sum(map(matmul, layer["weights"], inputs)) + layer["bias"][:, None]


@jax.custom_vjp
def matmul(weights: jax.Array, x: jax.Array) -> jax.Array:
    """`weights[O, I] x[I, M]`: multiplied in the dtype of `x`, summed in that of `weights`.

    `jax.grad` of the plain product would mix float32 cotangents with bfloat16 operands, which no
    machine has a fast product for; here every product has operands of the dtype of `x`.
    """
    return _dot(weights.astype(x.dtype), x, weights.dtype)


def _matmul_forward(weights, x):
    return matmul(weights, x), (weights, x)


def _matmul_backward(residuals, cotangent):
    weights, x = residuals
    cotangent = cotangent.astype(x.dtype)
    # Transposed before the cast: a real copy, where a transpose alone would be folded into a
    # product that contracts leading axes, which CPUs are slow at.
    d_x = _dot(weights.T.astype(x.dtype), cotangent, weights.dtype).astype(x.dtype)
    d_weights = jax.lax.dot_general(
        cotangent, x, (((1,), (1,)), ((), ())), preferred_element_type=weights.dtype
    )
    return d_weights, d_x


matmul.defvjp(_matmul_forward, _matmul_backward)


def _dot(a, b, dtype):
    return jax.lax.dot(a, b, preferred_element_type=dtype)


def init_network(
    key: jax.Array,
    *,
    depth: int,
    width: int,
    skip_after: int,
    position_features: int,
    direction_features: int,
    direction_width: int,
) -> Params:
    """Parameters of NeRF's network (NeRF, fig. 7); see `apply_network` for what its parts do."""
    keys = iter(jax.random.split(key, depth + 4))
    trunk = []
    for i in range(depth):
        fan_ins = (position_features,) if i == 0 else (width,)
        if i == skip_after + 1:
            fan_ins = (width, position_features)
        trunk.append(init_dense(next(keys), fan_ins, width))
    return {
        "trunk": trunk,
        "density": init_dense(next(keys), (width,), 1),
        "feature": init_dense(next(keys), (width,), width),
        "view": init_dense(next(keys), (width, direction_features), direction_width),
        "rgb": init_dense(next(keys), (direction_width,), 3),
    }


def apply_network(network: Params, positions: jax.Array, directions: jax.Array) -> Features:
    """Evaluate the network on R rays of S samples each, all in one flat batch.

    Args:
      network: from `init_network`.
      positions: `[I, R * S]` encoded, the samples of a ray side by side. Products are computed in
        this dtype.
      directions: `[J, R]` encoded.
    """
    h = positions
    for layer in network["trunk"]:
        inputs = (h, positions)[: len(layer["weights"])]
        h = jax.nn.relu(dense(layer, *inputs)).astype(positions.dtype)
    # The feature layer is linear and feeds a linear one: their product is one smaller layer.
    feature, view = network["feature"], network["view"]
    from_feature, from_directions = view["weights"]
    from_h = from_feature @ feature["weights"][0]
    bias = view["bias"] + from_feature @ feature["bias"]
    by_ray = matmul(from_directions, directions) + bias[:, None]
    by_sample = matmul(from_h, h).reshape(*by_ray.shape, -1) + by_ray[..., None]
    seen = jax.nn.relu(by_sample).astype(positions.dtype).reshape(by_ray.shape[0], -1)
    return Features(dense(network["density"], h)[0], dense(network["rgb"], seen))
