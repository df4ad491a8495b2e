"""Time rendered and differentiated surfels against a plain scan and against their arithmetic.

The discs lie at points that the photographs of `table` see, as at the start of training. The plain
scan uses the same projection and the same tile lists: all tiles step through their lists together,
and `jax.grad` differentiates the scan. The bound is the time for the arithmetic of all
(pixel, splat) evaluations at this machine's rate of matrix products.
"""

import contextlib
import dataclasses
import functools
import math
import os
import time

import jax
import jax.numpy as jnp
from jax import lax

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.app.score.targets import exact_depths
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.splats import RasterizeConfig, render_surfels, surfels_from_points
from jaxcloseup.fields.splats.layout import pack
from jaxcloseup.fields.splats.projection import project_discs, surfel_columns, to_camera
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.fields.splats.splat_math import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from jaxcloseup.fields.splats.tile_test import reaches
from jaxcloseup.fields.splats.tiling import tile_lists
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.photos.views import to_float


CASES = (  # discs, and the image's size
    (10_000, (68, 120)),
    (30_000, (135, 240)),
    (20_000, (270, 480)),
    (100_000, (270, 480)),
    (100_000, (540, 960)),
)
# Additions, products, comparisons and selections of one evaluation; exp and 1/x count as one.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 76, 136
SCAN_BYTES = 6e9  # the scan is skipped if its stored steps need more memory


def run() -> None:
    """Print a table of milliseconds, ratios, memory and compile time."""
    rate = matmul_rate()
    print(
        f"matrix product: {rate / 1e9:.0f} GFLOP/s; the table shows milliseconds of the forward "
        "pass and of both passes, and how many times slower the scan is in forward/both"
    )
    print(
        "splats     image   pairs/px  forward    both  one core  cores       scan    ratios"
        "  bound  MiB  (scan)  compile s"
    )
    scene = load_scene("table", downscale=4)
    for count, size in CASES:
        _report(*discs_on_table(scene, count, size), rate)
    print("a wavy wall, which gives all tiles lists of nearly the same length:")
    _report(*discs_on_a_wall(20_000, (270, 480)), rate)


def _report(surfels, camera, rate):
    count, size = surfels.means.shape[0], (camera.height, camera.width)
    config = config_for(surfels, camera)
    pairs, longest = count_pairs(surfels, camera, config)

    loss = functools.partial(loss_of_all, functools.partial(render_all, config=config))
    forward, both = jax.jit(loss), jax.jit(jax.grad(loss, argnums=(0, 1)))
    start = time.perf_counter()
    compiled = both.lower(surfels, camera).compile()
    compile_seconds = time.perf_counter() - start
    memory = compiled.memory_analysis().temp_size_in_bytes

    pixels = -(-size[0] // config.tile) * -(-size[1] // config.tile) * config.tile**2
    calls = {"forward": lambda: forward(surfels, camera), "both": lambda: compiled(surfels, camera)}
    scan_memory = None
    if pixels * longest * 80 < SCAN_BYTES:
        loss = functools.partial(
            loss_of_all, functools.partial(_render_by_scan, config=config, longest=longest)
        )
        plain = jax.jit(jax.grad(loss, argnums=(0, 1))).lower(surfels, camera).compile()
        plain_forward = jax.jit(loss)
        scan_memory = plain.memory_analysis().temp_size_in_bytes
        calls["scan"] = lambda: plain(surfels, camera)
        calls["scan forward"] = lambda: plain_forward(surfels, camera)
        _check(compiled(surfels, camera), plain(surfels, camera))
    seconds = interleaved_medians(calls, 5)
    with _one_core():
        alone = interleaved_medians({"both": calls["both"]}, 3)["both"]

    operations = FORWARD_OPERATIONS + BACKWARD_OPERATIONS
    bound = pairs * config.tile**2 * operations / rate
    scan, ratios, scan_mib = (
        (
            f"{1e3 * seconds['scan forward']:.0f}/{1e3 * seconds['scan']:.0f}",
            f"{seconds['scan forward'] / seconds['forward']:.1f}/"
            f"{seconds['scan'] / seconds['both']:.1f}",
            f"{scan_memory / 2**20:.0f}",
        )
        if "scan" in calls
        else ("-", "-", "-")
    )
    print(
        f"{count:>6}  {size[1]:>4}x{size[0]:<4} {pairs * config.tile**2 / pixels:>8.1f}"
        f"  {1e3 * seconds['forward']:>7.0f} {1e3 * seconds['both']:>7.0f}  {1e3 * alone:>8.0f}"
        f"  {alone / seconds['both']:>5.2f}  {scan:>9}  {ratios:>8}  {1e3 * bound:>5.0f}"
        f"  {memory / 2**20:>3.0f}  {scan_mib:>6}  {compile_seconds:>9.1f}",
        flush=True,
    )


def config_for(surfels, camera):
    """Return the configuration for an image, with as much room as it needs."""
    plan = plan_raster(RasterizeConfig(), height=camera.height, width=camera.width)
    guess = RasterizeConfig(capacity=plan.capacity, tile=plan.tile)
    touched, _ = count_pairs(surfels, camera, guess, exact=False)
    return dataclasses.replace(guess, capacity=-(-touched // 2**14) * 2**14)


def discs_on_table(scene, count, size):
    """Return discs at random points that the photographs see, and the first photograph's camera."""
    key_pixel, key_opacity, key_surfels = jax.random.split(jax.random.key(0), 3)
    cameras, depths = scene.train.cameras, exact_depths(scene, scene.train.cameras)
    grid = pixel_grid(cameras.height, cameras.width)
    points = jax.vmap(pixels_to_points, (0, None, 0))(cameras, grid, depths).reshape(-1, 3)
    chosen = jax.random.choice(key_pixel, len(points), (count,), replace=False)
    rgb = to_float(scene.train.rgb).reshape(-1, 3)
    surfels, _ = surfels_from_points(
        key_surfels, points[chosen], rgb[chosen], capacity=count, sh_degree=0
    )
    logits = 1.5 * jax.random.normal(key_opacity, (count,))
    first = jax.tree.map(lambda leaf: leaf[0], cameras)
    scale = jnp.array([size[1] / cameras.width, size[0] / cameras.height])
    camera = Camera(first.camtoworld, first.intrinsics * jnp.tile(scale, 2), *size)
    return surfels.replace(opacity_logits=logits), camera


def discs_on_a_wall(count, size):
    """Return discs on a wavy surface, the best case of a scan, and a camera that they fill."""
    keys = jax.random.split(jax.random.key(0), 6)
    a, b = jax.random.uniform(keys[0], (2, count), minval=-1)
    z = 3.5 + 0.8 * jnp.sin(3 * a) * jnp.cos(2 * b) + 0.25 * jax.random.normal(keys[1], (count,))
    points = jnp.stack([0.55 * a * z, 0.32 * b * z, z], axis=-1)
    surfels, _ = surfels_from_points(
        keys[2], points, jax.random.uniform(keys[3], (count, 3)), capacity=count, sh_degree=0
    )
    spread = 0.4 * jax.random.normal(keys[4], (count, 2))
    log_scales = jnp.log(0.56 * z[:, None] / math.sqrt(count)) + spread
    facing = jnp.array([[1.0, 0, 0, 0]]) + 0.35 * surfels.quaternions
    logits = 1.5 * jax.random.normal(keys[5], (count,))
    surfels = surfels.replace(log_scales=log_scales, quaternions=facing, opacity_logits=logits)
    intrinsics = jnp.array([0.95 * size[1], 0.95 * size[1], size[1] / 2, size[0] / 2])
    return surfels, Camera(jnp.eye(4)[:3], intrinsics, *size)


def loss_of_all(render, surfels, camera):
    """Return a loss of every output, as in training with all regularizers."""
    rgb, depth, normal, distortion = render(surfels, camera)
    loss = jnp.mean((rgb - 0.4) ** 2) + 0.05 * jnp.mean((depth - 3) ** 2)
    return loss + 0.05 * jnp.mean(normal[..., 2]) + 0.1 * jnp.mean(distortion)


def render_all(surfels, camera, config):
    """Return the color, depth, normal and distortion of an image."""
    alive = jnp.ones(surfels.means.shape[0], bool)
    image = render_surfels(surfels, alive, camera, config)
    return image.rgb, image.depth, image.aux.normal, image.aux.distortion


def footprints(surfels, camera, config):
    """Return the footprints of surfels."""
    discs, normals = to_camera(surfel_columns(surfels), camera)
    offset = surfels.means - camera.position[None]
    colors = sh_to_rgb(surfels.sh, offset / safe_norm(offset, keepdims=True))
    payload = jnp.stack([*colors.T, *normals])
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    return project_discs(discs, opacity, payload, camera, near=config.near)


def _lists(footprints, camera, config, *, exact=True):
    """Return lists of the splats that draw in each tile, or whose boxes touch it."""
    table = pack(footprints)
    return tile_lists(
        lax.stop_gradient(footprints.box.T),
        lax.stop_gradient(footprints.order),
        height=camera.height,
        width=camera.width,
        tile=config.tile,
        capacity=config.capacity,
        reaches=functools.partial(reaches, table, tile=config.tile, near=config.near)
        if exact
        else None,
    )


def count_pairs(surfels, camera, config, *, exact=True):
    """Return the number of (tile, surfel) pairs, and the most that fit in one tile's list."""
    lists = _find_lists(surfels, camera, config, exact)
    return int(lists.counts.sum() + lists.overflow), int(lists.counts.max())


@functools.partial(jax.jit, static_argnums=(2, 3))
def _find_lists(surfels, camera, config, exact):
    return _lists(footprints(surfels, camera, config), camera, config, exact=exact)


def _render_by_scan(surfels, camera, config, longest):
    """Blend all tiles together, one splat of each list at a time."""
    splats = footprints(surfels, camera, config)
    lists = _lists(lax.stop_gradient(splats), camera, config)
    splats = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), splats)
    starts, counts, origins = lists.starts, lists.counts, lists.origins
    inner = jnp.arange(config.tile) + 0.5
    inner = jnp.stack(jnp.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    pixels = origins[:, None] + inner[None]  # [T, P, 2]

    def step(carry, place):
        transmittance, sums = carry
        index = lists.splats[jnp.where(place < counts, starts + place, 0)]
        splat = jax.tree.map(lambda leaf: leaf[index][:, None], splats)
        d = pixels - splat.anchor
        u, v, w = (
            splat.homography[..., i, 0] + jnp.sum(splat.homography[..., i, 1:] * d, axis=-1)
            for i in range(3)
        )
        floor = splat.low_pass * jnp.sum(d * d, axis=-1)
        on_plane = (w > 0) & (u * u + v * v <= floor * w * w)
        z = 1 / jnp.where(on_plane, w, jnp.clip(w, *jnp.moveaxis(splat.inverse_depth, -1, 0)))
        rho = jnp.where(on_plane, (u * u + v * v) * z * z, floor)
        alpha = jnp.minimum(splat.opacity * jnp.exp(-rho / 2), ALPHA_MAX)
        drawn = (alpha >= ALPHA_MIN) & (w * config.near <= 1) & (place < counts)[:, None]
        alpha = jnp.where(drawn, alpha, 0)
        after = transmittance * (1 - alpha)
        weight = jnp.where(after >= TRANSMITTANCE_MIN, alpha * transmittance, 0)[..., None]
        inverse = 1 / z[..., None]
        values = [jnp.broadcast_to(splat.payload, (*z.shape, 6)), z[..., None]]
        values += [jnp.ones_like(inverse), inverse, inverse**2]
        return (after, sums + weight * jnp.concatenate(values, axis=-1)), None

    start = jnp.ones(pixels.shape[:2]), jnp.zeros((*pixels.shape[:2], 10))
    (_, sums), _ = lax.scan(step, start, jnp.arange(longest, dtype=jnp.int32))
    down, across = -(-camera.height // config.tile), -(-camera.width // config.tile)
    image = sums.reshape(down, across, config.tile, config.tile, 10).swapaxes(1, 2)
    image = image.reshape(down * config.tile, across * config.tile, 10)
    image = image[: camera.height, : camera.width]
    depth, alpha, first, second = (image[..., i] for i in range(6, 10))
    distortion = alpha * second - first * first
    return image[..., :3], safe_divide(depth, alpha), image[..., 3:6], distortion


def _check(gradient, expected):
    """Check that both have the same derivative up to rounding."""
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        if float(jnp.max(jnp.abs(a - b))) > 1e-2 * float(jnp.max(jnp.abs(b))):
            raise AssertionError("the splatter and the scan disagree on a derivative")


def matmul_rate():
    """Return the operations per second of a large matrix product."""
    side = 2048
    matrix = jax.random.normal(jax.random.key(0), (side, side))
    product = jax.jit(lambda a: a @ a)
    return 2 * side**3 / interleaved_medians({"product": lambda: product(matrix)})["product"]


@contextlib.contextmanager
def _one_core():
    """Keep all threads of this process on one core, if the system allows it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    try:
        _pin(set(sorted(allowed)[:1]))
        yield
    finally:
        _pin(allowed)


def _pin(cores):
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), cores)
