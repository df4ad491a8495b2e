"""Frames and videos of a stored run, in folders."""

import functools
import pathlib
from collections.abc import Callable, Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.exposed import how_taken
from jaxcloseup.app.run.fine_tuning import fine_tune, tuned_detail
from jaxcloseup.app.run.kept_detail import detail_getter, detail_path
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_run import StoredRun, restore
from jaxcloseup.app.view.camera_paths import CameraError, Shots, dolly, find_view
from jaxcloseup.app.view.frames import render_shots
from jaxcloseup.app.view.photograph_pixels import pinhole_pixel
from jaxcloseup.app.view.picking import surface_depth
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.photos.scene import Scene
from jaxcloseup.training.steps import TrainState


AUTO, MIDDLE = "auto", "middle"  # exposures: as the camera would choose it; that of no photograph


def dolly_towards(
    scene: Scene,
    view: str,
    pixel: tuple[float, float],
    *,
    magnification: float,
    frames: int,
    resize: Callable[[Shots], Shots],
) -> Callable[[Programs, TrainState], Shots]:
    """Return a function that makes a dolly towards the surface at a pixel, for a trained state.

    Args:
      scene: what was photographed.
      view: name of the training view from which the dolly begins.
      pixel: (x, y) in the photograph at its own size.
      magnification: how many times nearer to the surface the dolly ends.
      frames: number of cameras.
      resize: gives frames, which have the photograph's own size, another one.

    Raises:
      CameraError: there is no such view or pixel, frames are too large, and, from the function, the
        state shows no surface at the pixel.
    """
    index = find_view(scene, view)
    camera, asked = scene.own_camera("train", index), pixel
    pixel = pinhole_pixel(scene, index, pixel)
    # Refuses what is too large.
    resize(Shots(jax.tree.map(lambda leaf: leaf[None], camera), [view]))

    def make(programs: Programs, state: TrainState) -> Shots:
        render = functools.partial(programs.render, state)
        depth = surface_depth(render, camera, pixel, far=scene.far)
        if depth <= 0:
            x, y = asked
            raise CameraError(
                f"--pixel={x:g},{y:g}: the stage renders no surface at this pixel of {view}: "
                "choose another pixel"
            )
        return resize(dolly(camera, pixel, depth, magnification=magnification, frames=frames))

    return make


def render_run(
    output_dir: pathlib.Path,
    record: StoredRun,
    scene: Scene,
    stage: str,
    make_shots: Callable[[Programs, TrainState], Shots],
    *,
    support: bool,
    detail: bool,
    fine_tuned: bool,
    most_steps: int | None,
    exposure: str = AUTO,
) -> tuple[Shots, list[pathlib.Path]]:
    """Render cameras of a stored run; return them and the folders of their images.

    Args:
      output_dir: folder to write.
      record: the run.
      scene: its scene.
      stage: whose state is rendered.
      make_shots: `(programs, state) -> Shots`, the cameras.
      support: also render which photographs support each pixel.
      detail: add the detail that photographs show beyond the field.
      fine_tuned: first train for exactly these cameras.
      most_steps: largest number of steps of this training; None: the preset's.
      exposure: of the renders, see `choose_exposure`.
    """
    programs, state = restore(record, scene, stage)
    choose_exposure(programs, exposure)
    shots = make_shots(programs, state)
    sources = None
    if support or fine_tuned:
        expected = record.preset.labels.expected_depth
        start = start_labels(programs, state, expected_depth=expected)
        sources = start.sources if support else None
    begin = start.state if fine_tuned else state
    kept = detail_path(record.folder, stage) if begin is state else None
    find, added = detail_getter(programs, begin, kept), None
    if fine_tuned:
        state = fine_tune(programs, start, shots.cameras, find, most=most_steps)
    if detail:
        added, _ = find()
        # What was fine-tuned for these cameras is not kept, and its detail neither.
        if state is not begin:
            added = tuned_detail(programs, state, shots.cameras, added)
    folders = render_shots(output_dir, programs, state, shots, sources=sources, detail=added)
    print(f"{len(shots.names)} frames: {', '.join(str(folder) for folder in folders)}")
    return shots, folders


def choose_exposure(programs: Programs, exposure: str) -> None:
    """Choose the exposure of all renders: `AUTO`, `MIDDLE`, or the name of a photograph.

    Raises:
      CameraError: there is no such photograph.
    """
    if exposure == AUTO:
        return
    if exposure != MIDDLE:
        view = find_view(programs.scene, exposure, flag="exposure")
        programs.taken = how_taken(programs, "train", programs.scene.names["train"][view])
    elif (taken := how_taken(programs, None, None)) is not None:
        programs.taken = taken._replace(gain=jnp.ones(3))


def write_videos(shots: Shots, folders: list[pathlib.Path], *, fps: float) -> None:
    """Write each folder of images as a video beside it."""

    def write(folder: pathlib.Path) -> pathlib.Path:
        return write_video(folder, _images(folder, shots), fps=fps)

    for path in progress.each(write, folders, "writing videos"):
        print(f"video: {path}")
    if path.suffix != ".mp4":
        print('MP4 videos need imageio-ffmpeg: install jaxcloseup with the extra "video"')


def _images(folder: pathlib.Path, shots: Shots) -> Iterator[np.ndarray]:
    for name in shots.names:
        image = cv2.imread(str(folder / f"{name}.png"))
        assert image is not None  # written just now
        yield image[..., ::-1]
