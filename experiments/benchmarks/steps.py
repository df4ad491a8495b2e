"""Time training steps on windows of full-size photographs, by the number of surfels.

The surfels lie at points that the photographs of `table` see, as large as the gaps between them, so
a window shows a share of them. A step should cost what its window shows, however many there are.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.timing import interleaved_medians
from jaxcloseup.app.methods.surfels import QUICK
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.app.score.targets import exact_depths
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.splats.spherical_harmonics import rgb_to_sh
from jaxcloseup.fields.splats.splat_field import SurfelBuffers
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import pixel_grid, pixels_to_points
from jaxcloseup.io.memory import peak_memory
from jaxcloseup.photos.views import to_float
from jaxcloseup.training.state import TrainState


COUNTS = 60_000, 250_000, 1_000_000
STEPS = 10, 60  # of a short and a long call: both sort the surfels once, as runs do every 500 steps


def run() -> None:
    """Print milliseconds of a step, by number of surfels, and the memory in use."""
    scene = load_scene("table", downscale=QUICK.downscale)
    points, rgb, spacing = _seen_points(scene)
    calls = {}
    for count in COUNTS:
        programs, state = _trained_on(scene, points, rgb, spacing, count)
        windows = programs.photographs
        levels = len(windows.shares)
        for name, level in (("window of a photograph's own size", 0), ("photograph", levels - 1)):
            share = jnp.zeros(levels).at[level].set(1)
            data = TrainData(dataclasses.replace(windows, shares=share))

            for number in STEPS:

                def steps(programs=programs, state=state, data=data, number=number):
                    return programs.run(state, data, count=number)[0].params.means

                calls[f"{count:,} surfels, {name}", number] = steps
                jax.block_until_ready(steps())
        memory = (peak_memory() or float("nan")) / 2**20
        print(f"{count:,} surfels: {memory:.0f} MiB at most so far", flush=True)
    medians = {key: 1e3 * seconds for key, seconds in interleaved_medians(calls, 3).items()}
    few, many = STEPS
    for name in dict.fromkeys(name for name, _ in medians):
        step = (medians[name, many] - medians[name, few]) / (many - few)
        print(f"{name}: {step:.1f} ms a step, {medians[name, few] - few * step:.0f} to sort them")


def _seen_points(scene):
    """Return points of random pixels of the photographs, colors, and the pixels' sizes there."""
    cameras, depths = scene.train.cameras, exact_depths(scene, scene.train.cameras)
    grid = pixel_grid(cameras.height, cameras.width)
    points = jax.vmap(pixels_to_points, (0, None, 0))(cameras, grid, depths).reshape(-1, 3)
    size = (depths / cameras.intrinsics[:, :1, None]).reshape(-1)
    return points, to_float(scene.train.rgb).reshape(-1, 3), size


def _trained_on(scene, points, rgb, spacing, count):
    """Return programs and a state with `count` surfels at seen points."""
    raster = dataclasses.replace(QUICK.field.raster, capacity=2**19)
    field = dataclasses.replace(QUICK.field, capacity=count, raster=raster, depth_weight=0.0)
    programs = Programs(dataclasses.replace(QUICK, field=field, stereo=None), scene)
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(points), count)
    # Photographs overlap: this many of their pixels show one surfel.
    scale = spacing[chosen] * (len(points) / 8 / count) ** 0.5
    within = rng.uniform(-0.5, 0.5, (count, 3)) * np.asarray(scale)[:, None]
    surfels = Surfels(
        means=points[chosen] + jnp.asarray(within, jnp.float32),
        log_scales=jnp.log(0.5 * scale)[:, None] * jnp.ones(2),
        quaternions=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        opacity_logits=jnp.asarray(rng.normal(size=count), jnp.float32),
        sh=jnp.pad(rgb_to_sh(rgb[chosen])[:, None], ((0, 0), (0, 3), (0, 0))),
    )
    one = jnp.ones(())
    buffers = SurfelBuffers(jnp.ones(count, bool), jnp.int32(1), one, 0 * one)
    moments = programs.optimizer.init(surfels)
    # After the last relocation.
    return programs, TrainState(jnp.int32(1000), surfels, buffers, moments, jax.random.key(0))
