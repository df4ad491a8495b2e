"""Frames and videos of a stored run: what `experiments.render` does."""

import datetime
import math
import pathlib
import sys
from collections.abc import Iterator

import cv2
import numpy as np
from absl import flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli.start import check_unused, prepare_to_stop, set_up
from jaxcloseup.app.run.fine_tuning import fine_tune, tuned_detail
from jaxcloseup.app.run.kept_detail import detail_getter, detail_path
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, restore
from jaxcloseup.app.view import camera_files, camera_paths
from jaxcloseup.app.view.camera_paths import CameraError, Shots
from jaxcloseup.app.view.chosen_run import run_from_flags
from jaxcloseup.app.view.frames import render_shots
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.scene import SceneError


FLAGS = flags.FLAGS
# Flags that only these camera sources accept.
_ONLY_WITH = {
    **dict.fromkeys(("frames", "width", "height"), ("orbit", "from")),
    **dict.fromkeys(("pixel", "magnification"), ("from",)),
    "up": ("orbit",),
    "camera_transform": ("camera_path", "target"),
}


def main() -> None:
    """Render the cameras that the flags choose."""
    set_up()
    try:
        with progress.showing():
            _render()
    except (
        *(RunError, CameraError, SceneError),
        *(CheckpointError, TrainingError, OSError),
    ) as error:
        sys.exit(f"experiments.render: {error}")


def _render() -> None:
    # Cheap checks come before loading the scene and the state.
    chosen = _camera_source()
    record, stage = run_from_flags()
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
    output_dir = check_unused(FLAGS.output_dir or record.folder / "videos" / stamp)
    prepare_to_stop(output_dir)
    file = FLAGS.target or FLAGS.camera_path
    shots = camera_files.read_camera_path(pathlib.Path(file)) if file else None
    file = FLAGS.camera_transform
    transform = camera_files.read_camera_transform(pathlib.Path(file)) if file else None
    scene = load_run_scene(record, FLAGS.data)
    if transform is not None:
        shots = camera_files.to_capture(shots, *transform, scene)
    if chosen == "views":
        shots = camera_paths.view_shots(scene, FLAGS.views)
    elif chosen == "orbit":
        shots = _resized(camera_paths.orbit(scene, FLAGS.frames, up=_up()))
    elif chosen == "from":
        index = camera_paths.find_view(scene, FLAGS["from"].value)
        view = scene.camera("train", index)
        pixel = _pixel()
        row, column = camera_paths.check_pixel(view, pixel)
        camera_paths.resized(view, FLAGS.width, FLAGS.height)  # refuses what is too large

    programs, state = restore(record, scene, stage)
    if chosen == "from":
        seen = label_depth(programs.render(state, view), near=0, far=scene.far)
        depth = float(seen[row, column])
        if depth <= 0:
            raise CameraError(
                f"--pixel={','.join(FLAGS.pixel)}: stage {stage} renders no surface at this pixel "
                f"of {FLAGS['from'].value}: choose another pixel"
            )
        shots = _resized(
            camera_paths.dolly(
                view, pixel, depth, magnification=FLAGS.magnification, frames=FLAGS.frames
            )
        )
    fine_tuned = FLAGS.fine_tune or FLAGS.target is not None
    sources = None
    if FLAGS.support or fine_tuned:
        expected = record.preset.labels.expected_depth
        start = start_labels(
            programs, state, run_keys(record.identity["seed"]), expected_depth=expected
        )
        sources = start.sources if FLAGS.support else None
    begin = start.state if fine_tuned else state
    kept = detail_path(record.folder, stage) if begin is state else None
    find, detail = detail_getter(programs, begin, kept), None
    if fine_tuned:
        state = fine_tune(programs, start, shots.cameras, find, most=FLAGS.target_steps)
    if FLAGS.detail:
        detail, _ = find()
        # What was fine-tuned for these cameras is not kept, and its detail neither.
        if state is not begin:
            detail = tuned_detail(programs, state, shots.cameras, detail)
    folders = render_shots(output_dir, programs, state, shots, sources=sources, detail=detail)
    print(f"{len(shots.names)} frames: {', '.join(str(folder) for folder in folders)}")
    if chosen != "views" and len(shots.names) > 1:
        for folder in folders:
            path = write_video(folder, _images(folder, shots), fps=FLAGS.fps or shots.fps or 30.0)
            print(f"video: {path}")
        if path.suffix != ".mp4":
            print('MP4 videos need imageio-ffmpeg: install jaxcloseup with the extra "video"')


def _camera_source() -> str:
    """Check the flags; return the one that chooses the cameras."""
    sources = ("views", "camera_path", "target", "orbit", "from")
    given = [source for source in sources if FLAGS[source].value]
    if len(given) != 1:
        raise CameraError(
            "give exactly one of --views, --camera_path, --target, --orbit and --from, not "
            + (" and ".join(f"--{source}" for source in given) or "none")
        )
    for flag, sources in _ONLY_WITH.items():
        if FLAGS[flag].value != FLAGS[flag].default and given[0] not in sources:
            raise CameraError(f"--{flag} does not apply to --{given[0]}: leave it out")
    if FLAGS.target_steps is not None and not (FLAGS.fine_tune or given[0] == "target"):
        raise CameraError("--target_steps needs --fine_tune or --target: leave it out, or add one")
    if FLAGS.fps is not None and not 0 < FLAGS.fps <= 1000:
        raise CameraError(f"--fps={FLAGS.fps:g} must be above 0 and at most 1000")
    if given[0] == "from":
        if not 1 <= FLAGS.magnification < float("inf"):
            raise CameraError(
                f"--magnification={FLAGS.magnification:g} must be 1 or more: a dolly moves nearer"
            )
        _pixel()
    _up()
    return given[0]


def _pixel() -> tuple[float, float]:
    try:
        x, y = map(float, FLAGS.pixel or ())
    except ValueError:
        raise CameraError(
            "--from needs --pixel=x,y: give a pixel of that view as two numbers"
        ) from None
    return x, y


def _up() -> tuple[float, ...] | None:
    if FLAGS.up is None:
        return None
    try:
        x, y, z = map(float, FLAGS.up)
        length = math.hypot(x, y, z)
        if not 0 < length < math.inf:
            raise ValueError
    except ValueError:
        raise CameraError(
            f"--up={','.join(FLAGS.up)} must be three finite numbers x,y,z, not all 0"
        ) from None
    return x / length, y / length, z / length


def _resized(shots: Shots) -> Shots:
    return shots._replace(cameras=camera_paths.resized(shots.cameras, FLAGS.width, FLAGS.height))


def _images(folder: pathlib.Path, shots: Shots) -> Iterator[np.ndarray]:
    for name in shots.names:
        yield cv2.imread(str(folder / f"{name}.png"))[..., ::-1]
