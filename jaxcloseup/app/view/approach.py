"""Render a camera that moves from a photograph towards the surface that a close-up shows."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.targets import Target
from jaxcloseup.app.view.camera_paths import dolly, named_cameras, resized_shots
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixels_to_points, points_to_pixels
from jaxcloseup.labels.make import LabelSources
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.labels.target_views import best_source


FRAMES = 24
LONGEST = 960  # side of frames in pixels
MAGNIFICATION = (1.5, 8.0)  # smallest and largest: the close-up may be no nearer
_ENOUGH = 10  # photographs; more make no better support


def approach(
    targets: Sequence[Target],
    sources: LabelSources,
    render: Callable[[Camera], Rendering],
    *,
    far: float,
) -> list[np.ndarray]:
    """Render a dolly from the photograph that overlaps the best-supported close-up most.

    The camera does not turn, so it ends as near as the close-up to the point in its middle.

    Args:
      targets: held-out close-ups; frames are as large as they are, but no longer than `LONGEST`.
      sources: the training photographs with their depths.
      render: `camera -> Rendering`.
      far: largest depth.

    Returns:
      Frames, uint8 `[H, W, 3]`; none if the middle of the rendered close-up is empty.
    """
    target = max(targets, key=lambda target: float(jnp.mean(jnp.minimum(target.seen, _ENOUGH))))
    camera = target.camera
    depth = label_depth(render(camera), near=0, far=far)
    view = int(jax.jit(best_source)(camera, sources.views, sources.depths, depth=depth))
    # The lens of the close-up gives all frames one shape.
    start = camera.replace(camtoworld=sources.views.cameras.camtoworld[view])
    row, column = camera.height // 2, camera.width // 2
    middle = pixels_to_points(camera, jnp.array([column + 0.5, row + 0.5]), depth[row, column])
    pixel, distance = points_to_pixels(start, middle)
    if not (depth[row, column] > 0 and distance > 0):
        return []
    nearer = float(distance / depth[row, column])
    shots = dolly(
        start,
        (float(pixel[0]), float(pixel[1])),
        float(distance),
        magnification=float(np.clip(nearer, *MAGNIFICATION)),
        frames=FRAMES,
    )
    shots = resized_shots(shots, None, None, min(1.0, LONGEST / max(camera.height, camera.width)))

    def frame(camera: Camera) -> np.ndarray:
        return to_uint8(render(camera).rgb)

    cameras = [camera for _, camera in named_cameras(shots)]
    pixels = shots.cameras.height * shots.cameras.width
    return list(progress.each(frame, cameras, "frames", pixels=pixels))
