"""Training steps and images of a NeRF, against the matrix products that they consist of.

The ceiling is the product that a NeRF of 1024 rays would do, 65536 x 256 x 256. A second one is the
same arithmetic in pieces that stay in the cache, which is how the NeRF does it.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.batch import Batch
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.rendered_loss import rendered_loss
from jaxcloseup.volume.nerf import NerfConfig, nerf


FULL = NerfConfig()
SMALL = NerfConfig(depth=4, direction_width=64, num_coarse=32, num_fine=32)
NUM_RAYS = 1024
ROWS, WIDTH = 65536, 256


def run() -> None:
    """Measure and print; about three minutes on two cores."""
    full = {"float32": FULL, "bfloat16": dataclasses.replace(FULL, compute_dtype="bfloat16")}
    small = {width: dataclasses.replace(SMALL, width=width) for width in (64, 96, 128)}
    calls = {}
    for name in full:
        calls["ceiling", name] = product(jnp.dtype(name), ROWS)
        calls["in cache", name] = product(jnp.dtype(name), FULL.rays_at_once * 128)
    memory = {}
    for name, config in full.items():
        calls["step", name], memory["training step", name] = training_step(config)
        calls["image", name], memory["image, depth only", name] = depth_image(config)
    calls["recomputing", "float32"], memory["recomputing step", "float32"] = training_step(
        FULL, recompute=True
    )
    for width, config in small.items():
        calls["step", width], _ = training_step(config)
    seconds = interleaved_medians(calls, repeats=3)

    product_flops = 2 * ROWS * WIDTH**2
    rates = {
        call: product_flops / seconds[call] / 1e9
        for call in calls
        if call[0] in ("ceiling", "in cache")
    }
    for call in calls:
        if call[0] in ("step", "recomputing") and call[1] in full:
            rates[call] = NUM_RAYS * training_flops(FULL) / seconds[call] / 1e9
    print(f"\nNeRF 8 x 256, 64 + 64 samples, {NUM_RAYS} rays, forward, backward and Adam")
    print(f"{'':36}{'float32':>12}{'bfloat16':>12}")
    row("ceiling 65536x256x256, GFLOP/s", rates, "ceiling")
    row("the same in pieces in cache, GFLOP/s", rates, "in cache")
    row("training step, s", seconds, "step")
    row("training step, GFLOP/s", rates, "step")
    share = {("share", name): 100 * rates["step", name] / rates["ceiling", name] for name in full}
    row("  % of the ceiling", share, "share")
    share = {("share", name): 100 * rates["step", name] / rates["in cache", name] for name in full}
    row("  % of the pieces in cache", share, "share")
    row("plain gradient of render, s", seconds, "recomputing")
    row("depth image, rays/s", {k: IMAGE**2 / s for k, s in seconds.items()}, "image")
    for name in ("training step", "recomputing step", "image, depth only"):
        row(f"temporaries, {name}, MB", memory, name)
    ratio = seconds["step", "float32"] / seconds["step", "bfloat16"]
    print(f"bfloat16 step is {ratio:.2f} times as fast as float32")
    print(f"\nNeRF of depth 4, 32 + 32 samples, {NUM_RAYS} rays, float32")
    for width in small:
        print(f"  width {width:4}: {1e3 * seconds['step', width]:7.1f} ms a step")


def row(title: str, values: dict, name: str) -> None:
    """Print a row of the table; what was not measured stays empty."""
    cells = (values.get((name, dtype)) for dtype in ("float32", "bfloat16"))
    print(f"{title:36}" + "".join(f"{cell:12.4g}" if cell else " " * 12 for cell in cells))


def training_flops(config: NerfConfig) -> int:
    """Matrix FLOPs of one ray, forward and backward: 2 m n k for each product needed.

    A layer needs one product forward and two backward, for its weights and for its input, but none
    for the gradient of an encoded input. The linear feature layer counts as folded into the next,
    which is what is computed (the original's figure is 13 % higher). Recomputation does not count.
    """
    inputs = 3 + 6 * config.position_octaves
    skip = config.skip_after + 1 < config.depth
    encoded = inputs * config.width * (1 + skip)
    hidden = (config.depth - 1) * config.width**2
    heads = config.direction_width * (config.width + 3) + config.width
    samples = 2 * config.num_coarse + config.num_fine
    return 2 * samples * (2 * encoded + 3 * (hidden + heads))


def product(dtype: jnp.dtype, rows: int) -> Callable[[], jax.Array]:
    """As many products of `rows` rows as make up ROWS, rows last, summed in float32."""
    weights = jnp.ones((WIDTH, WIDTH), dtype)
    x = jnp.ones((WIDTH, rows), dtype)
    dot = jax.jit(functools.partial(jax.lax.dot, preferred_element_type=jnp.float32))

    def call():
        for _ in range(ROWS // rows):
            out = dot(weights, x)
        return out

    return call


def training_step(config: NerfConfig, *, recompute: bool = False):
    """A step on random pixels, and its temporary memory in MB."""
    field = nerf(config, near=0.5, far=4.0)
    params, buffers = jax.jit(field.init)(jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    optimizer = optax.adam(5e-4)
    key_pixels, key_rgb, key_step = jax.random.split(jax.random.key(1), 3)
    cameras = jax.tree.map(lambda x: jnp.tile(x, (NUM_RAYS,) + (1,) * x.ndim), CAMERA)
    pixels = IMAGE * jax.random.uniform(key_pixels, (NUM_RAYS, 2))
    batch = Batch(cameras, pixels, jax.random.uniform(key_rgb, (NUM_RAYS, 3)), jnp.ones(NUM_RAYS))
    chunk = None if recompute else config.rays_at_once

    def step(params, opt_state, key):
        loss = functools.partial(rendered_loss, field=field, chunk=chunk)
        gradient, metrics = jax.grad(loss, has_aux=True)(params, buffers, batch, key)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return optax.apply_updates(params, updates), opt_state, metrics

    return compiled(step, params, optimizer.init(params), key_step)


def depth_image(config: NerfConfig):
    """The depth of an image of IMAGE x IMAGE pixels, and its temporary memory in MB."""
    field = nerf(config, near=0.5, far=4.0)
    params, buffers = jax.jit(field.init)(jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    return compiled(lambda p: field.render(p, buffers, CAMERA, None, None).depth, params)


def compiled(function: Callable, *args):
    """A call without arguments, and the temporary memory that it takes in MB."""
    executable = jax.jit(function).lower(*args).compile()
    memory = executable.memory_analysis().temp_size_in_bytes / 1e6
    return functools.partial(executable, *args), memory


IMAGE = 48
CAMERA = Camera(jnp.eye(4)[:3], jnp.array([48.0, 48.0, 24.0, 24.0]), IMAGE, IMAGE)
