"""Measure flicker and time of detail, with the newest run of surfels on `table` in `outputs`.

*Flicker* is the mean absolute difference between neighboring frames of a dolly, warped onto each
other with the rendered depth. Interpolation by the warp blurs sharp frames, which adds to their
differences. So the suite also renders frames twice as large and averages differences over 2 x 2
pixels, and measures the true frames of the scene and the errors of frames, whose flicker is not in
the scene.

*Time* is that of a frame and of its parts, the library's own code beside JAX's, and what bounds
them: the networks' arithmetic at the speed of one large product of matrices, and one visit to all
residuals at the speed at which arrays are copied.
"""

import functools
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.timing import interleaved_medians
from experiments.studies.trained_run import newest_run
from jaxcloseup.app.run.kept_detail import detailed
from jaxcloseup.app.view.camera_paths import dolly, resized
from jaxcloseup.detail.add import SETTINGS
from jaxcloseup.detail.holes import fill_holes, find_empty
from jaxcloseup.detail.strips import predict_by_strips
from jaxcloseup.geometry import warp_to
from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos import gather_native
from jaxcloseup.photos.gather import gather_parts
from jaxcloseup.photos.views import camera_at


FRAMES, WIDTH, REPEATS = 60, 240, 5
SIZES = 960, 480  # widths of frames that are timed
EVERY = 3  # pair of frames that are twice as large
VIEWS = (3, 25, 47)  # training photographs from which dollies start


def run() -> None:
    """Print flicker with and without detail, and the time of a frame and of its parts."""
    run = newest_run()
    scene, programs, state, detail = run.scene, run.programs, run.state, run.detail()

    def shoot(camera):
        seen = programs.render(state, camera)
        depth = label_depth(seen, near=0, far=scene.far)
        plain, sharp = jnp.clip(seen.rgb, 0, 1), detailed(programs, detail, camera, seen).rgb
        truth = scene.surface(camera).rgb
        return camera, depth, (plain, sharp, truth, plain - truth, sharp - truth)

    for view in VIEWS:
        camera = camera_at(scene.train.cameras, view)
        middle = camera.width / 2, camera.height / 2
        seen = label_depth(programs.render(state, camera), near=0, far=scene.far)
        depth = float(seen[camera.height // 2, camera.width // 2])
        shots = dolly(camera, middle, depth, magnification=4, frames=FRAMES)
        print(f"dolly from {scene.names['train'][view]}:")
        for times, every in ((1, 1), (2, EVERY)):
            cameras = resized(shots.cameras, times * WIDTH, None)
            shot = functools.cache(lambda i, cameras=cameras: shoot(camera_at(cameras, i)))
            pairs = ((shot(i), shot(i + 1)) for i in range(0, FRAMES - 1, every))
            found = np.mean([_flicker(*pair, times) for pair in pairs], axis=0)
            print(f"  {_describe(*found)}, differences averaged over {times} x {times} pixels")
    for width in SIZES:
        camera = camera_at(resized(shots.cameras, width, None), FRAMES // 2)
        _print_times(run, detail, camera)


def _print_times(run, detail, camera):
    """Print the milliseconds of a frame and of its parts."""
    seen = jax.block_until_ready(run.programs.render(run.state, camera))
    pixels = pixel_grid(camera.height, camera.width)
    depth = label_depth(seen, near=0, far=run.scene.far)
    where = camera, pixels, depth, detail.sources, detail.shown
    gathered = gather_parts(*where, SETTINGS)
    predict = jax.jit(predict_by_strips)
    empty = jax.jit(find_empty)(camera, pixels, detail.sources)
    there = gathered[0].weight > 0
    calls = {
        "render": lambda: run.programs.render(run.state, camera),
        "detail": lambda: detailed(run.programs, detail, camera, seen),
        "gather": lambda: gather_parts(*where, SETTINGS),
        "gather in JAX": lambda: _gather_in_jax(*where),
        "features and networks": lambda: predict(
            *(detail.weights, detail.finer, gathered, seen.rgb, seen.alpha, depth)
        ),
        "find empty places": lambda: _find_empty(camera, pixels, detail.sources, ~there),
        "fill holes": lambda: _fill_holes(seen.rgb, seen.alpha, there, empty),
        "bound of networks": functools.partial(_multiply, _operations(detail, depth.size)),
        "bound of gathering": functools.partial(_copy, detail.shown.values),
    }
    first = {}
    for name, call in calls.items():
        start = time.perf_counter()
        jax.block_until_ready(call())
        first[name] = time.perf_counter() - start
    print(f"{camera.width} x {camera.height}, ms, and the first call in s:")
    for name, seconds in interleaved_medians(calls, REPEATS).items():
        print(f"  {name:22} {1e3 * seconds:8.1f} {first[name]:8.2f}")


def _gather_in_jax(*where):
    with mock.patch.object(gather_native, "can_gather", return_value=False):
        return gather_parts(*where, SETTINGS)


_find_empty, _fill_holes, _copy = jax.jit(find_empty), jax.jit(fill_holes), jax.jit(jnp.copy)


def _operations(detail, pixels):
    """Return the additions and multiplications of all networks."""
    networks = detail.weights.mixing, detail.weights.errors
    return 2 * pixels * sum(matrix.size for each in networks for matrix in each.layers[::2])


@jax.jit
def _square(matrix):
    return matrix @ matrix


def _multiply(operations):
    """Multiply matrices that take as many operations."""
    return _square(jnp.ones([round((operations / 2) ** (1 / 3))] * 2))


_warp = jax.jit(warp_to)


def _describe(plain, sharp, truth, plain_error, sharp_error):
    return (
        f"without detail {plain:.5f}, with detail {sharp:.5f} ({sharp / plain:.2f} times that), "
        f"truth {truth:.5f} ({truth / plain:.2f} times); of their errors {plain_error:.5f} and "
        f"{sharp_error:.5f} ({sharp_error / plain_error:.2f} times)"
    )


def _flicker(before, after, times):
    """Return the mean difference of two frames, for each kind of their images.

    Differences are first averaged over blocks of `times` x `times` visible pixels.
    """
    camera, depth, images = after
    differences = []
    for old, new in zip(before[2], images, strict=True):
        moved = _warp(old, before[0], camera, depth, source_depth=before[1], tolerance=0.02)
        difference = jnp.where(moved.hit[..., None], moved.values - new, 0)
        valid = _averaged(moved.hit[..., None].astype(jnp.float32), times)[..., 0] == 1
        averaged = jnp.abs(_averaged(difference, times)).mean(-1)
        differences.append(float(averaged[valid].mean()))
    return differences


def _averaged(image, times):
    """Average an image `[H, W, C]` over blocks of `times` x `times` pixels; cut the rest."""
    height, width = (size // times for size in image.shape[:2])
    parts = image[: height * times, : width * times]
    return parts.reshape(height, times, width, times, -1).mean((1, 3))
