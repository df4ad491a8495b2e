"""Render held-out views of drawn scenes with stored runs, and put pictures in rows."""

import pathlib
from collections.abc import Sequence

import imageio.v3 as imageio
import numpy as np

from experiments.studies.trained_run import TrainedRun
from jaxcloseup.app.run.kept_detail import detailed
from jaxcloseup.app.view.camera_paths import resized
from jaxcloseup.artifacts.images import side_by_side, to_uint8
from jaxcloseup.detail.add import Detailed
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.files import write_file
from jaxcloseup.photos.views import camera_at


def closeup_camera(run: TrainedRun, name: str, width: int) -> Camera:
    """Return the camera of a held-out close-up with images of another width."""
    index = run.scene.names["test"].index(name)
    return resized(camera_at(run.scene.test.cameras, index), width, None)


def render_truth(run: TrainedRun, camera: Camera) -> np.ndarray:
    """Render the true image of a drawn scene, `[H, W, 3]`."""
    if run.scene.surface is None:
        raise SystemExit(f"{run.folder}: pictures need a run of a drawn scene")
    return np.asarray(run.scene.surface(camera).rgb)


def render_detailed(run: TrainedRun, camera: Camera) -> Detailed:
    """Render the state of a run with detail and with the expected error."""
    seen = run.programs.render(run.state, camera)
    return detailed(run.programs, run.detail(), camera, seen)


def write_rows(
    path: str | pathlib.Path, rows: Sequence[Sequence[np.ndarray]], labels: Sequence[str] | None
) -> None:
    """Write pictures in rows as a JPEG file; the first row has labels."""
    drawn = [
        side_by_side(map(to_uint8, row), labels=None if i else labels, gap=6)
        for i, row in enumerate(rows)
    ]
    width = max(row.shape[1] for row in drawn)
    padded = [
        np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255)
        for row in drawn
    ]
    data = imageio.imwrite("<bytes>", np.concatenate(padded), extension=".jpg", quality=88)
    write_file(path, data)
