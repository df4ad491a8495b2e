"""Time training steps and images of a NeRF against the matrix products that they consist of.

The ceiling is one product of 65536 x 256 x 256, the size for 1024 rays. The pieces are the same
arithmetic in parts that stay in the cache, as in the NeRF.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.fields.volume.config import NerfConfig
from jaxcloseup.fields.volume.nerf import nerf_field
from jaxcloseup.fields.volume.networks import rays_in_cache
from jaxcloseup.fields.volume.rays import Extent
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.views import Batch
from jaxcloseup.training.loss import rendered_loss


FULL = NerfConfig()
SMALL = NerfConfig(depth=4, direction_width=64, num_coarse=32, num_fine=32)
SMALL_WIDTHS = (64, 96, 128)
NUM_RAYS = 256  # the NeRF takes 16 rays at a time, so 1024 rays take four times as long
IMAGE = 32
CAMERA = Camera(jnp.eye(4)[:3], jnp.array([32.0, 32.0, 16.0, 16.0]), IMAGE, IMAGE)
ROWS, WIDTH = 65536, 256
DTYPES = ("float32", "bfloat16")


def run() -> None:
    """Print a table of times, rates and memory."""
    calls, megabytes = {}, {}
    for dtype in DTYPES:
        config = dataclasses.replace(FULL, compute_dtype=dtype)
        calls["ceiling", dtype] = product(dtype, ROWS)
        calls["pieces", dtype] = product(dtype, min(ROWS, 128 * _rays_at_once(FULL)))
        calls["step", dtype], megabytes["step", dtype] = training_step(config)
        calls["again", dtype], megabytes["again", dtype] = training_step(config, recompute=True)
        calls["image", dtype], megabytes["image", dtype] = depth_image(config)
    for width in SMALL_WIDTHS:
        calls["step", width], _ = training_step(dataclasses.replace(SMALL, width=width))
    seconds = interleaved_medians(calls, repeats=5)

    flops = {"ceiling": 2 * ROWS * WIDTH**2, "step": NUM_RAYS * training_flops(FULL)}
    flops |= {"pieces": flops["ceiling"], "again": flops["step"]}
    rate = {call: flops[call[0]] / s / 1e9 for call, s in seconds.items() if call[0] in flops}
    print(f"\nNeRF 8 x 256, 64 + 64 samples; a training step has {NUM_RAYS} rays, with Adam")
    print(f"{'':44}{'float32':>10}{'bfloat16':>10}")
    row("ceiling 65536 x 256 x 256, GFLOP/s", [rate["ceiling", d] for d in DTYPES])
    row("the same in pieces that stay in the cache", [rate["pieces", d] for d in DTYPES])
    row("training step, GFLOP/s", [rate["step", d] for d in DTYPES])
    row("  % of the ceiling", [100 * rate["step", d] / rate["ceiling", d] for d in DTYPES])
    row("  % of the pieces", [100 * rate["step", d] / rate["pieces", d] for d in DTYPES])
    row("  ms", [1e3 * seconds["step", d] for d in DTYPES])
    row(
        "  speed relative to float32",
        [seconds["step", DTYPES[0]] / seconds["step", d] for d in DTYPES],
    )
    row("  temporaries, MB", [megabytes["step", d] for d in DTYPES])
    row("plain gradient (renders twice), ms", [1e3 * seconds["again", d] for d in DTYPES])
    row("  temporaries, MB", [megabytes["again", d] for d in DTYPES])
    row("depth image, rays/s", [IMAGE**2 / seconds["image", d] for d in DTYPES])
    row("  temporaries, MB", [megabytes["image", d] for d in DTYPES])
    print(f"\nNeRF of depth 4, 32 + 32 samples; a training step of {NUM_RAYS} rays, float32")
    for width in SMALL_WIDTHS:
        row(f"width {width}, ms", [1e3 * seconds["step", width]])


def row(title: str, cells: list[float]) -> None:
    """Print a row of the table."""
    print(f"{title:44}" + "".join(f"{cell:10.4g}" for cell in cells))


def training_flops(config: NerfConfig) -> int:
    """Return the matrix FLOPs of one ray, forward and backward: 2 m n k for each product needed.

    A layer needs one product forward and two backward, for its weights and for its input. The
    gradient of an encoded input is not needed. The linear feature layer counts as folded into the
    next layer, as computed here; the original's count is 13 % higher. Recomputation does not count.
    """
    inputs = 3 + 6 * config.position_octaves
    skip = config.skip_after + 1 < config.depth
    encoded = inputs * config.width * (1 + skip)
    hidden = (config.depth - 1) * config.width**2
    heads = config.direction_width * (config.width + 3) + config.width
    samples = 2 * config.num_coarse + config.num_fine
    return 2 * samples * (2 * encoded + 3 * (hidden + heads))


def product(dtype: str, rows: int) -> Callable[[], jax.Array]:
    """Return a call that does products of `rows` rows, in all ROWS rows, summed in float32."""
    weights = jnp.ones((WIDTH, WIDTH), dtype)
    x = jnp.ones((WIDTH, rows), dtype)
    dot = jax.jit(functools.partial(jax.lax.dot, preferred_element_type=jnp.float32))

    def call():
        for _ in range(ROWS // rows):
            out = dot(weights, x)
        return out

    return call


def training_step(config: NerfConfig, *, recompute: bool = False, num_rays: int = NUM_RAYS):
    """Return a training step on random pixels, and its temporary memory in MB."""
    field = nerf_field(config, Extent(0.5, 4.0))
    params, buffers = jax.jit(field.init)(jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    optimizer = optax.adam(5e-4)
    key_pixels, key_rgb, key_step = jax.random.split(jax.random.key(1), 3)
    cameras = jax.tree.map(lambda x: jnp.tile(x, (num_rays,) + (1,) * x.ndim), CAMERA)
    pixels = IMAGE * jax.random.uniform(key_pixels, (num_rays, 2))
    batch = Batch(cameras, pixels, jax.random.uniform(key_rgb, (num_rays, 3)), jnp.ones(num_rays))
    chunk = None if recompute else _rays_at_once(config)

    def step(params, opt_state, key):
        loss = functools.partial(rendered_loss, field=field, chunk=chunk)
        gradient, metrics = jax.grad(loss, has_aux=True)(params, buffers, batch, key)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return optax.apply_updates(params, updates), opt_state, metrics

    return compiled(step, params, optimizer.init(params), key_step)


def depth_image(config: NerfConfig):
    """Return a call that renders the depth of IMAGE x IMAGE pixels, and its temporary MB."""
    field = nerf_field(config, Extent(0.5, 4.0))
    params, buffers = jax.jit(field.init)(jax.random.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    return compiled(lambda p: field.render(p, buffers, CAMERA, None, None).depth, params)


def compiled(function: Callable, *args):
    """Compile a function; return a call without arguments, and its temporary memory in MB."""
    executable = jax.jit(function).lower(*args).compile()
    memory = executable.memory_analysis().temp_size_in_bytes / 1e6
    return functools.partial(executable, *args), memory


def _rays_at_once(config: NerfConfig) -> int:
    return rays_in_cache(config.num_coarse + config.num_fine, config.width)
