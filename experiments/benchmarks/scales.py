"""Compare renders at two scales, with the newest run of surfels on `table` in `outputs`.

The suite renders every held-out view at its size, and four times as large and then reduced. If both
agree, the field is right at both scales.
"""

import jax.numpy as jnp
import numpy as np

from experiments.studies.trained_run import newest_run
from jaxcloseup.app.view.camera_paths import resized
from jaxcloseup.metrics.image_metrics import psnr
from jaxcloseup.photos.views import camera_at, to_float


TIMES = 4


def run() -> None:
    """Print the PSNR of both renders against each other, and of each against the truth."""
    run = newest_run()
    for split, views in (("close-ups", run.scene.test), ("ordinary views", run.scene.test_far)):
        scores = []
        for index in range(len(views)):
            camera = camera_at(views.cameras, index)
            fine = resized(camera, TIMES * camera.width, TIMES * camera.height)
            direct, large = (
                jnp.clip(run.programs.render(run.state, c).rgb, 0, 1) for c in (camera, fine)
            )
            reduced = large.reshape(camera.height, TIMES, camera.width, TIMES, 3).mean((1, 3))
            truth = to_float(views.rgb[index])
            pairs = (direct, reduced), (direct, truth), (reduced, truth)
            scores.append([float(psnr(*pair)) for pair in pairs])
        agreement, direct, reduced = np.mean(scores, axis=0)
        print(
            f"{split}: both renders agree to {agreement:.1f} dB; against the truth {direct:.2f} dB,"
            f" reduced from {TIMES} times the size {reduced:.2f} dB"
        )
