"""Agreement of scales of the newest run of surfels on `table` in `outputs`.

Every held-out view is rendered at its own size, and four times as large and then reduced. Where
both show the same, what is learned at one scale is right at the other.
"""

import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.newest_run import newest_run
from jaxcloseup.app.view.camera_paths import resized
from jaxcloseup.metrics.image_metrics import psnr
from jaxcloseup.photos.views import camera_at, to_float


TIMES = 4


def run() -> None:
    """Print the PSNR of both renders against each other, and of each against the truth."""
    _, _, scene, programs, state = newest_run()
    for split, views in (("close-ups", scene.test), ("ordinary views", scene.test_far)):
        found = []
        for index in range(len(views)):
            camera = camera_at(views.cameras, index)
            fine = resized(camera, TIMES * camera.width, TIMES * camera.height)
            own, large = (jnp.clip(programs.render(state, c).rgb, 0, 1) for c in (camera, fine))
            reduced = large.reshape(camera.height, TIMES, camera.width, TIMES, 3).mean((1, 3))
            truth = to_float(views.rgb[index])
            pairs = (own, reduced), (own, truth), (reduced, truth)
            found.append([float(psnr(one, other)) for one, other in pairs])
        agreement, own, reduced = np.mean(found, axis=0)
        print(
            f"{split}: both renders agree to {agreement:.1f} dB; against the truth {own:.2f} dB, "
            f"reduced from {TIMES} times the size {reduced:.2f} dB"
        )
