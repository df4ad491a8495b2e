"""Render a finished or interrupted run: its views, a camera path, an orbit or a dolly.

    python -m experiments.render --run=outputs/table/surfels/... --views=test
    python -m experiments.render --run=... --camera_path=camera_path.json [--fine_tune]
    python -m experiments.render --run=... --orbit --frames=120
    python -m experiments.render --run=... --from=train_003 --pixel=60,40 --magnification=4

The program writes a folder of images for each of `rgb`, `depth`, `normals` (surfels only),
`support`, which shows how many training photographs saw each pixel and how sharply, and `trust`,
how much of their detail was added to `rgb`; `--nodetail` shows the field alone. Except for
`--views`, it also writes each folder as a video. A dolly moves from a training view straight
towards the surface at a pixel. `--fine_tune` first trains for exactly the rendered cameras, on
pseudo-labels made for them; `--target=FILE` is short for `--camera_path=FILE --fine_tune`.
"""

import datetime
import math
import pathlib
import sys
from collections.abc import Iterator

import cv2
import numpy as np
from absl import app, flags

from experiments.command_line import check_unused, prepare_to_stop, set_up, start
from experiments.training.detail import detail_path, find_detail
from experiments.training.fine_tuning import fine_tune
from experiments.training.loop import TrainingError
from experiments.training.setup import start_labels
from experiments.training.stored_run import RunError, load_run_scene, restore
from experiments.viewing import camera_paths
from experiments.viewing.camera_paths import CameraError, Shots
from experiments.viewing.flags import run_from_flags
from experiments.viewing.frames import render_shots
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.label_rules import label_depth
from jaxcloseup.scene import SceneError


FLAGS = flags.FLAGS
for _name in ("output_dir", "run", "stage", "data", "set"):
    flags.declare_key_flag(_name)
flags.DEFINE_string("views", None, "split whose cameras to render: test, test_far or train")
flags.DEFINE_string("camera_path", None, "camera_path.json whose cameras to render")
flags.DEFINE_string(
    "camera_transform",
    None,
    "dataparser_transforms.json of the nerfstudio run in which the camera path was made; it maps "
    "the path back to the capture's coordinates; default: the path is already in them",
)
flags.DEFINE_string("target", None, "short for --camera_path with --fine_tune")
flags.DEFINE_bool(
    "orbit", False, "render an orbit around the point that the training cameras look at"
)
flags.DEFINE_list(
    "up", None, "x,y,z: the world's up direction in --orbit; default: the cameras' mean up"
)
flags.DEFINE_string("from", None, "training view from which to render a dolly towards --pixel")
flags.DEFINE_list("pixel", None, "x,y: pixel of the --from view, at the view's training size")
flags.DEFINE_float("magnification", 4.0, "how many times nearer to the surface a dolly ends")
flags.DEFINE_integer(
    "frames",
    60,
    "number of frames of an orbit or a dolly",
    lower_bound=1,
    upper_bound=100_000,
)
flags.DEFINE_float("fps", None, "frames per second of the video; default: the camera path's, or 30")
flags.DEFINE_integer(
    "width",
    None,
    "frame width of an orbit or a dolly in pixels; default: from --height, or the training views'",
    lower_bound=1,
    upper_bound=2**31 - 1,
)
flags.DEFINE_integer(
    "height",
    None,
    "frame height of an orbit or a dolly in pixels; default: from --width, or the training views'",
    lower_bound=1,
    upper_bound=2**31 - 1,
)
flags.DEFINE_bool("fine_tune", False, "first fine-tune for exactly the cameras that are rendered")
flags.DEFINE_integer(
    "target_steps", None, "maximum steps of --fine_tune; default: the preset's", lower_bound=1
)
flags.DEFINE_bool(
    "support", True, "also render support, which needs the depth of every training photograph"
)
flags.DEFINE_bool(
    "detail", True, "add the detail that the photographs show beyond the field; made once for a run"
)


# Flags that only these camera sources accept.
_ONLY_WITH = {
    **dict.fromkeys(("frames", "width", "height"), ("orbit", "from")),
    **dict.fromkeys(("pixel", "magnification"), ("from",)),
    "up": ("orbit",),
    "camera_transform": ("camera_path", "target"),
}


def main(argv: list[str]) -> None:
    """Render the cameras that the flags choose."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    try:
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
    shots = camera_paths.read_camera_path(pathlib.Path(file)) if file else None
    file = FLAGS.camera_transform
    transform = camera_paths.read_camera_transform(pathlib.Path(file)) if file else None
    scene = load_run_scene(record, FLAGS.data)
    if transform is not None:
        shots = camera_paths.to_capture(shots, *transform, scene)
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
        start = start_labels(programs, state, record.identity["seed"], expected_depth=expected)
        sources = start.sources if FLAGS.support else None
    if fine_tuned:
        kept = detail_path(record.folder, stage) if start.state is state else None
        cameras, most = shots.cameras, FLAGS.target_steps
        state = fine_tune(programs, start, cameras, most=most, kept=kept)
    detail = None
    if FLAGS.detail:
        # What was fine-tuned for these cameras is not kept, and its detail neither.
        path = None if fine_tuned else detail_path(record.folder, stage)
        detail, _ = find_detail(programs, state, path)
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


if __name__ == "__main__":
    start(main)
