"""Residuals of a run's states, with OpenCV's interpolation and blur.

`jaxcloseup.detail.residuals` needs no OpenCV; results of runs keep its rounding.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import jax
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.photograph_sizes import finest_read
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.detail import residuals
from jaxcloseup.detail.residuals import Residuals
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.training.state import TrainState


# How many times finer than reduced photographs a state is rendered at least, and as fine as steps
# read photographs; for finer ones the render is enlarged.
FINER = 4
FINER_RAYS = 1  # the same for fields that render single rays, and so whole images slowly


def render_residuals(
    programs: Programs, state: TrainState, pyramid: Pyramid, views: Sequence[int] | None = None
) -> Residuals:
    """Render photographs' views, and subtract the renders from the photographs at every level.

    Renders are as fine as the photographs that steps read: what is finer, the state has not
    learned. `views` are indices of photographs, all by default.
    """
    scene = programs.scene
    read = scene.metadata.get("downscale", 1) / finest_read(programs.preset, scene)
    most = FINER_RAYS if programs.method.renders_pixels else max(FINER, read)
    return residuals.render_residuals(
        lambda camera: programs.render(state, camera),
        scene.train.cameras,
        pyramid,
        views,
        near=scene.near,
        far=scene.far,
        brightest=brightest(programs),
        rendered=pyramid.level_near(most * scene.train.cameras.width),
        enlarge=enlarge,
        each=lambda compare, views: progress.each(compare, views, "residuals of photographs"),
    )


def brightest(programs: Programs) -> float:
    """Return the largest color of renders, see `Detail`."""
    return 1.0 if programs.exposures is None else np.inf


def enlarge(rgb: Any, camera: Camera, finer: Camera) -> np.ndarray:
    """Enlarge a render to what a camera with the same pose and finer pixels shows."""
    (fx, fy, cx, cy), (gx, gy, dx, dy) = map(np.asarray, (camera.intrinsics, finer.intrinsics))
    x = (np.arange(finer.width) + 0.5 - dx) / gx * fx + cx - 0.5
    y = (np.arange(finer.height) + 0.5 - dy) / gy * fy + cy - 0.5
    columns, rows = (axis.astype(np.float32) for axis in np.meshgrid(x, y))
    replicate = cv2.BORDER_REPLICATE
    return cv2.remap(np.asarray(rgb), columns, rows, cv2.INTER_CUBIC, borderMode=replicate)


def reproduced(shown: Pyramid) -> jax.Array:
    """Return how far the model reproduces each photograph, `[V, H, W]` in [0, 1]."""
    return residuals.reproduced(shown, blur=_blur)


def _blur(images: np.ndarray, deviation: float) -> np.ndarray:
    return np.stack([cv2.GaussianBlur(image, (0, 0), deviation) for image in images])
