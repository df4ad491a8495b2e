"""The network of a NeRF, features first: activations are `[features, samples]`.

Samples are the long axis of every product and, being last, contiguous, which makes the backward
pass fast on a CPU. A layer with several inputs has one matrix per input: nothing is concatenated.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint

from jaxcloseup.fields.volume.encodings import positional_encoding
from jaxcloseup.fields.volume.rays import Rays


Params = Any
_LARGEST_LOG_DENSITY = 15.0


class Raw(NamedTuple):
    """The network's output for M samples, before activation: density `[M]` and rgb `[3, M]`."""

    density: jax.Array
    rgb: jax.Array


def rays_in_cache(samples: int, width: int) -> int:
    """Choose how many rays to process at once, so that one layer's activations stay small.

    Small is 2 MB on a CPU, the size of a core's cache, and 512 MB elsewhere. A whole image needs
    about 4 times as much memory, a training step `2 depth + 4` times.

    Args:
      samples: samples per ray.
      width: features of each.
    """
    # Asked here, so that a field made without a `chunk` fits the device that will render it.
    activations = 2**19 if jax.default_backend() == "cpu" else 2**27
    return max(1, activations // (samples * width))


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
    """Initialize NeRF's network (NeRF, fig. 7), Glorot-uniform; `key` is consumed.

    Args:
      key: random key.
      depth: number of layers of the trunk.
      width: width of the trunk's layers.
      skip_after: index of the trunk's layer after which positions enter again.
      position_features: number of features of an encoded position.
      direction_features: number of features of an encoded direction.
      direction_width: width of the layer that sees directions.
    """
    fan_ins: list[tuple[int, ...]] = [(position_features,), *[(width,)] * (depth - 1)]
    if skip_after + 1 < depth:
        fan_ins[skip_after + 1] = (width, position_features)
    keys = jax.random.split(key, depth + 4)
    return {
        "trunk": [_init_layer(k, i, width) for k, i in zip(keys[:depth], fan_ins, strict=True)],
        "density": _init_layer(keys[-4], (width,), 1),
        "feature": _init_layer(keys[-3], (width,), width),
        "view": _init_layer(keys[-2], (width, direction_features), direction_width),
        "rgb": _init_layer(keys[-1], (direction_width,), 3),
    }


def apply_network(network: Params, positions: jax.Array, directions: jax.Array) -> Raw:
    """Evaluate the network on R rays of S samples each, all in one flat batch.

    Args:
      network: parameters from `init_network`.
      positions: `[I, R * S]` encoded positions, with the samples of a ray side by side.
      directions: `[J, R]` encoded directions of the same dtype, in which products are computed.
    """
    h = positions
    for layer in network["trunk"]:
        inputs = (h, positions)[: len(layer["weights"])]
        h = dense(layer["weights"], layer["bias"][:, None], inputs, True)
    density, feature, view, rgb = (network[k] for k in ("density", "feature", "view", "rgb"))
    # The feature layer is linear and feeds a linear layer: their product is one smaller layer.
    # The direction adds the same to all samples of a ray, so it becomes a bias.
    from_feature, from_direction = view["weights"]
    from_h = from_feature @ feature["weights"][0]
    bias = (view["bias"] + from_feature @ feature["bias"])[:, None]
    by_ray = dense((from_direction,), bias, (directions,), False)
    seen = dense((from_h,), by_ray, (h,), True)
    return Raw(
        density=dense(density["weights"], density["bias"][:, None], (h,), False)[0],
        rgb=dense(rgb["weights"], rgb["bias"][:, None], (seen,), False),
    )


def init_mlp(key: jax.Array, widths: Sequence[int], *, ray_features: int = 0) -> Params:
    """Initialize the layers of a small network, Glorot-uniform; `key` is consumed.

    Args:
      key: random key.
      widths: number of inputs, of each hidden layer's outputs, and of outputs.
      ray_features: inputs that all samples of a ray share, beside `widths[0]`.
    """
    keys = jax.random.split(key, len(widths) - 1)
    fan_ins = [(widths[0], ray_features)[: 1 + (ray_features > 0)]] + [(w,) for w in widths[1:-1]]
    return [_init_layer(*layer) for layer in zip(keys, fan_ins, widths[1:], strict=True)]


def apply_mlp(layers: Params, x: jax.Array, of_rays: jax.Array | None = None) -> jax.Array:
    """Evaluate a network from `init_mlp`: linear layers with positive parts between them.

    Args:
      layers: its parameters.
      x: `[I, R * S]` inputs, with the samples of a ray side by side.
      of_rays: `[J, R]` inputs that all samples of a ray share, if the network has any.

    Returns:
      `[O, R * S]`.
    """
    for i, layer in enumerate(layers):
        weights, bias = layer["weights"], layer["bias"][:, None]
        if len(weights) == 2:  # the same for all samples of a ray, so it becomes a bias
            bias = dense(weights[1:], bias, (of_rays,), False)
        x = dense(weights[:1], bias, (x,), i + 1 < len(layers))
    return x


def init_colors(key: jax.Array, widths: Sequence[int], octaves: int) -> Params:
    """Initialize the layers of a network for `apply_colors`; `key` is consumed.

    Args:
      key: random key.
      widths: number of inputs of a sample, and of each hidden layer's outputs.
      octaves: octaves of the positional encoding of view directions.
    """
    return init_mlp(key, (*widths, 3), ray_features=3 + 6 * octaves)


def apply_colors(layers: Params, x: jax.Array, rays: Rays, octaves: int) -> jax.Array:
    """Compute colors `[R, S, 3]` in [0, 1] of samples seen along their rays (NeRF, section 3).

    Args:
      layers: from `init_colors`.
      x: `[I, R * S]` features of the samples, with the samples of a ray side by side.
      rays: `[R]`.
      octaves: as in `init_colors`.
    """
    directions = positional_encoding(rays.unit, octaves)
    rgb = jax.nn.sigmoid(apply_mlp(layers, x, directions))
    return jnp.moveaxis(rgb.reshape(3, directions.shape[1], -1), 0, -1)


def exponential_density(raw: jax.Array) -> jax.Array:
    """Return densities exp(raw), finite for all raw values (Instant-NGP, section 5.4)."""
    return jnp.exp(jnp.minimum(raw, _LARGEST_LOG_DENSITY))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def dense(
    weights: Sequence[jax.Array], bias: jax.Array, inputs: Sequence[jax.Array], relu: bool
) -> jax.Array:
    """Compute `sum_i W_i x_i + b`, or its positive part.

    Products use the dtype of the inputs, sums that of the weights. Plain differentiation would
    multiply float32 cotangents with bfloat16 operands, keep values from before the activation and
    contract leading axes, all of which costs time.

    Args:
      weights: `[O, I_i]` per input.
      bias: `[O, G]`, a column per group; G groups of consecutive samples have equal sizes.
      inputs: `[I_i, M]`, all of one dtype.
      relu: whether negative values become 0; the result then has the dtype of the inputs.

    Returns:
      `[O, M]`.
    """
    chex.assert_rank([*weights, bias, *inputs], 2)
    dtype = inputs[0].dtype
    pairs = zip(weights, inputs, strict=True)
    out = jnp.asarray(sum(_dot(w.astype(dtype), x, w.dtype) for w, x in pairs))
    out = (out.reshape(*bias.shape, -1) + bias[..., None]).reshape(out.shape)
    return jax.nn.relu(out).astype(dtype) if relu else out


def _dense_forward(
    weights: Sequence[jax.Array], bias: jax.Array, inputs: Sequence[jax.Array], relu: bool
) -> tuple[jax.Array, tuple[Any, ...]]:
    out = dense(weights, bias, inputs, relu)
    return out, (weights, bias, inputs, out if relu else None)


def _dense_backward(
    relu: bool, residuals: tuple[Any, ...], cotangent: jax.Array
) -> tuple[tuple[jax.Array, ...], jax.Array, tuple[jax.Array, ...]]:
    weights, bias, inputs, out = residuals
    dtype = inputs[0].dtype
    cotangent = cotangent.astype(dtype)
    if relu:
        cotangent = jnp.where(out > 0, cotangent, 0)
    d_weights, d_inputs = [], []
    for w, x in zip(weights, inputs, strict=True):
        d_weights.append(_dot(cotangent, x, w.dtype, ((1,), (1,))))
        # A real copy, because a CPU's product is slow when it contracts the leading axis of W.
        transposed = with_layout_constraint(w.astype(dtype).T, Layout((0, 1)))
        d_inputs.append(_dot(transposed, cotangent, w.dtype).astype(dtype))
    d_bias = jnp.sum(cotangent.reshape(*bias.shape, -1), axis=-1, dtype=bias.dtype)
    return tuple(d_weights), d_bias, tuple(d_inputs)


dense.defvjp(_dense_forward, _dense_backward)


def _dot(
    a: jax.Array,
    b: jax.Array,
    dtype: jnp.dtype,
    contracting: tuple[tuple[int], tuple[int]] = ((1,), (0,)),
) -> jax.Array:
    # Do not pass a transposed array: its bfloat16 product is three times slower on a CPU.
    return jax.lax.dot_general(a, b, (contracting, ((), ())), preferred_element_type=dtype)


def _init_layer(key: jax.Array, fan_ins: Sequence[int], fan_out: int) -> Params:
    limit = (6 / (sum(fan_ins) + fan_out)) ** 0.5
    keys = jax.random.split(key, len(fan_ins))
    weights = tuple(
        jax.random.uniform(k, (fan_out, fan_in), minval=-limit, maxval=limit)
        for k, fan_in in zip(keys, fan_ins, strict=True)
    )
    return {"weights": weights, "bias": jnp.zeros(fan_out)}
