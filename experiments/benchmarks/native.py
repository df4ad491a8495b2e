"""Time the native compositor against loops of `jax.lax`, on the same splats.

Whole: surfels to an image, and both passes with all derivatives. Alone: compositing with its
derivative, less the lists of tiles, which each makes in its own way. The ceiling is the arithmetic
of all evaluations of a splat at a pixel at this machine's rate of matrix products.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from experiments.benchmarks import splats
from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.splats import blend_native
from jaxcloseup.fields.splats.blending import blend_tiles
from jaxcloseup.fields.splats.layout import pack
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.splats.tile_test import reaches
from jaxcloseup.fields.splats.tiling import tile_lists


CASES = [case for case in splats.CASES if case != (100_000, (270, 480))]


def run() -> None:
    """Print milliseconds, ratios, nanoseconds an evaluation and the share of the ceiling."""
    rate = splats.matmul_rate()
    print(f"matrix product: {rate / 1e9:.0f} GFLOP/s; milliseconds: loops / native = ratio")
    scene = load_scene("table", downscale=4)
    for count, size in CASES:
        surfels, camera = splats.discs_on_table(scene, count, size)
        config = splats.config_for(surfels, camera)
        print(f"{count} discs, {size[1]} x {size[0]}", flush=True)
        _time_whole(surfels, camera, config)
        _time_alone(surfels, camera, config, rate)


def _time_whole(surfels, camera, config):
    calls = {}
    for name in ("loops", "native"):
        own = dataclasses.replace(config, compositor=name)
        render = functools.partial(splats.render_all, config=own)
        loss = functools.partial(splats.loss_of_all, render)
        forward, both = jax.jit(loss), jax.jit(jax.grad(loss, argnums=(0, 1)))
        calls[f"forward {name}"] = functools.partial(forward, surfels, camera)
        calls[f"both {name}"] = functools.partial(both, surfels, camera)
    seconds = interleaved_medians(calls, 9)
    for part in ("forward", "both"):
        _print_ratio(f"whole, {part}", seconds[f"{part} loops"], seconds[f"{part} native"])


def _time_alone(surfels, camera, config, rate):
    """Time `blend_tiles` on lists that are there, and the native call less its lists, twice."""
    size = camera.height, camera.width
    footprints = jax.jit(lambda surfels: splats.footprints(surfels, camera, config))(surfels)
    table, box, order = pack(footprints), footprints.box.T, footprints.order
    plan = plan_raster(
        dataclasses.replace(config, compositor="loops"), height=size[0], width=size[1]
    )
    lists = jax.jit(
        lambda table, box, order: tile_lists(
            box,
            order,
            height=size[0],
            width=size[1],
            tile=plan.tile,
            capacity=plan.capacity,
            at_once=plan.pairs_at_once,
            reaches=functools.partial(reaches, table, tile=plan.tile, near=plan.near),
        )
    )
    made = lists(table, box, order)

    def squares(blended):
        return jnp.sum(blended[0] ** 2) + jnp.sum(blended[1])

    loops = jax.jit(jax.grad(lambda table: squares(blend_tiles(plan, table, made))))
    native = jax.jit(
        jax.grad(lambda table: squares(blend_native.blend_image(plan, *size, table, box, order)))
    )
    count = jax.jit(lambda table: blend_native.count_pairs(plan, *size, table, box, order))
    seconds = interleaved_medians(
        {
            "loops": lambda: loops(table),
            "native": lambda: native(table),
            "lists of loops": lambda: lists(table, box, order),
            "lists": lambda: count(table),
        },
        9,
    )
    _print_ratio("lists", seconds["lists of loops"], seconds["lists"])
    alone = seconds["native"] - 2 * seconds["lists"]
    _print_ratio("compositing alone, both", seconds["loops"], alone)
    evaluations = int(count(table).sum()) * blend_native.TILE**2
    ceiling = evaluations * (splats.FORWARD_OPERATIONS + splats.BACKWARD_OPERATIONS) / rate
    print(
        f"  {evaluations / size[0] / size[1]:.0f} evaluations a pixel, "
        f"{1e9 * alone / evaluations:.1f} ns each, both passes: {ceiling / alone:.0%} of the "
        f"ceiling (loops {ceiling / seconds['loops']:.0%})",
        flush=True,
    )


def _print_ratio(name, loops, native):
    print(f"  {name}: {1e3 * loops:.1f} / {1e3 * native:.1f} = {loops / native:.1f}", flush=True)
