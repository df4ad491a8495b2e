"""Measure flicker and time of detail, with the newest run of surfels on `table` in `outputs`.

*Flicker* is the mean absolute difference between neighboring frames of a dolly, warped onto each
other with the rendered depth. Interpolation by the warp blurs sharp frames, which adds to their
differences. So the suite also renders frames twice as large and averages differences over 2 x 2
pixels, and measures the true frames of the scene and the errors of frames, whose flicker is not in
the scene.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.timing import interleaved_medians
from experiments.trained_run import newest_run
from jaxcloseup.app.run.kept_detail import detailed
from jaxcloseup.app.view.camera_paths import dolly, resized
from jaxcloseup.geometry import warp_to
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.views import camera_at


FRAMES, WIDTH, REPEATS = 60, 240, 5
EVERY = 3  # pair of frames that are twice as large
VIEWS = (3, 25, 47)  # training photographs from which dollies start


def run() -> None:
    """Print flicker with and without detail, and the seconds of both halves of a view."""
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
    camera = camera_at(resized(cameras, 480, None), FRAMES // 2)
    seen = jax.block_until_ready(programs.render(state, camera))
    calls = {
        "render": lambda: programs.render(state, camera),
        "detail": lambda: detailed(programs, detail, camera, seen),
    }
    seconds = interleaved_medians(calls, REPEATS)
    print(
        f"{camera.width} x {camera.height}: "
        + ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items())
    )


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
