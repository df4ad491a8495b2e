"""Render a finished or cut-off run: its views, a camera path, an orbit or a dolly, as a video.

    python -m experiments.render --run=outputs/table/surfels/... --views=test
    python -m experiments.render --run=... --camera_path=camera_path.json [--fine_tune]
    python -m experiments.render --run=... --orbit --frames=120
    python -m experiments.render --run=... --from=train_003 --pixel=60,40 --magnification=4

A dolly goes from a training view straight towards the surface at a pixel. Beside color and depth
there are normals, of surfels, and `support`: how many training photographs saw a pixel, and how
sharply. `--fine_tune` first trains for exactly these cameras, with labels made for them;
`--target=FILE` is `--camera_path=FILE --fine_tune`.
"""

import datetime
import math
import pathlib
import sys
from collections.abc import Iterator

import cv2
import numpy as np
from absl import app, flags

from experiments.command_line import check_unused, set_up
from experiments.training.fine_tuning import fine_tune
from experiments.training.loop import TrainingError
from experiments.training.setup import start_labels
from experiments.training.stored_run import RunError, load_run_scene, restore
from experiments.viewing import camera_paths
from experiments.viewing.camera_paths import CameraError, Shots
from experiments.viewing.flags import named_run
from experiments.viewing.frames import render_shots
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.label_rules import label_depth
from jaxcloseup.photographs import camera_at
from jaxcloseup.scene import SceneError


FLAGS = flags.FLAGS
for _name in ("output_dir", "run", "stage", "data", "set"):
    flags.declare_key_flag(_name)
flags.DEFINE_string("views", None, "render the cameras of these photographs: test, test_far, train")
flags.DEFINE_string("camera_path", None, "render the cameras of this file, a camera_path.json")
flags.DEFINE_string(
    "camera_transform",
    None,
    "dataparser_transforms.json of the nerfstudio run in which the camera path was made: brings it "
    "back to the capture's coordinates; default: it is in these",
)
flags.DEFINE_string("target", None, "as --camera_path, with --fine_tune")
flags.DEFINE_bool("orbit", False, "render a circle around what the training cameras look at")
flags.DEFINE_list("up", None, "x,y,z in the world: up of an orbit; default: mean of the cameras'")
flags.DEFINE_string("from", None, "render a dolly from the training view of this name ...")
flags.DEFINE_list("pixel", None, "... towards the surface at its pixel x,y, as it was trained ...")
flags.DEFINE_float("magnification", 4.0, "... until it is so many times nearer")
flags.DEFINE_integer("frames", 60, "frames of an orbit or a dolly", lower_bound=1)
flags.DEFINE_float("fps", None, "frames a second; default: the camera path's, or 30")
flags.DEFINE_integer("width", None, "pixels of an orbit's or a dolly's frames", lower_bound=1)
flags.DEFINE_integer("height", None, "default: those of the training views", lower_bound=1)
flags.DEFINE_bool("fine_tune", False, "first fine-tune for the very cameras that are rendered")
flags.DEFINE_integer(
    "target_steps", None, "most steps of --fine_tune; default: the preset's", lower_bound=1
)
flags.DEFINE_bool("support", True, "also render what photographs saw; needs their depth first")


# What else there is to say of these ways alone.
_FOR = {
    **dict.fromkeys(("frames", "width", "height"), ("orbit", "from")),
    **dict.fromkeys(("pixel", "magnification"), ("from",)),
    "up": ("orbit",),
    "camera_transform": ("camera_path", "target"),
}


def main(argv: list[str]) -> None:
    """Render what the flags say."""
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
    # What costs nothing is checked first.
    way = _chosen_way()
    record, stage = named_run()
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
    output_dir = check_unused(FLAGS.output_dir or record.folder / "videos" / stamp)
    file = FLAGS.target or FLAGS.camera_path
    shots = camera_paths.read_camera_path(pathlib.Path(file)) if file else None
    moved = FLAGS.camera_transform
    moved = camera_paths.read_camera_transform(pathlib.Path(moved)) if moved else None
    scene = load_run_scene(record, FLAGS.data)
    if moved is not None:
        shots = camera_paths.to_capture(shots, *moved, scene)
    if way == "views":
        shots = camera_paths.view_shots(scene, FLAGS.views)
    elif way == "orbit":
        shots = _resized(camera_paths.orbit(scene, FLAGS.frames, up=_up()))
    elif way == "from":
        index = camera_paths.find_view(scene, FLAGS["from"].value)
        view = camera_at(scene.train.cameras, index)
        pixel = _pixel()
        row, column = camera_paths.check_pixel(view, pixel)

    programs, state = restore(record, scene, stage)
    if way == "from":
        seen = label_depth(programs.render(state, view), near=0, far=scene.far)
        depth = float(seen[row, column])
        if depth <= 0:
            raise CameraError(
                f"--pixel={','.join(FLAGS.pixel)} of {FLAGS['from'].value} has no depth, for the "
                f"{stage} shows no surface there: choose another pixel"
            )
        motion = {"magnification": FLAGS.magnification, "frames": FLAGS.frames}
        shots = _resized(camera_paths.dolly(view, pixel, depth, **motion))
    fine_tuned = FLAGS.fine_tune or FLAGS.target is not None
    sources = None
    if FLAGS.support or fine_tuned:
        expected = record.preset.labels.expected_depth
        start = start_labels(programs, state, record.identity["seed"], expected_depth=expected)
        sources = start.sources if FLAGS.support else None
    if fine_tuned:
        state = fine_tune(programs, start, shots.cameras, most=FLAGS.target_steps)
    folders = render_shots(output_dir, programs, state, shots, sources=sources)
    print(f"{len(shots.names)} frames: {', '.join(str(folder) for folder in folders)}")
    if way != "views" and len(shots.names) > 1:
        for folder in folders:
            path = write_video(folder, _images(folder, shots), fps=FLAGS.fps or shots.fps or 30.0)
            print(f"video: {path}")
        if path.suffix != ".mp4":
            print('MP4 needs imageio-ffmpeg: install jaxcloseup with the extra "video"')


def _chosen_way() -> str:
    """Which of the flags says what to render."""
    ways = ("views", "camera_path", "target", "orbit", "from")
    given = [way for way in ways if FLAGS[way].value]
    if len(given) != 1:
        named = "all of these are: " + ", ".join(given) if given else "none is"
        raise CameraError(
            "exactly one of --views, --camera_path, --target, --orbit and --from says what to "
            f"render, and {named}"
        )
    for flag, ways in _FOR.items():
        if FLAGS[flag].value != FLAGS[flag].default and given[0] not in ways:
            raise CameraError(f"--{flag} says nothing of --{given[0]}: leave it out")
    if FLAGS.target_steps is not None and not (FLAGS.fine_tune or given[0] == "target"):
        raise CameraError("--target_steps needs --fine_tune or --target: leave it out, or add one")
    if FLAGS.fps is not None and not 0 < FLAGS.fps <= 1000:
        raise CameraError(f"--fps={FLAGS.fps:g} must be above 0 and at most 1000")
    if given[0] == "from":
        if not 1 <= FLAGS.magnification < float("inf"):
            raise CameraError(
                f"--magnification={FLAGS.magnification:g} must be 1 or more: a dolly comes nearer"
            )
        _pixel()
    _up()
    return given[0]


def _pixel() -> tuple[float, float]:
    try:
        x, y = map(float, FLAGS.pixel or ())
    except ValueError:
        raise CameraError(
            "--from needs --pixel=x,y: two numbers, of a pixel of that view"
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
            f"--up={','.join(FLAGS.up)} must be three finite numbers x,y,z, not all of them 0"
        ) from None
    return x / length, y / length, z / length


def _resized(shots: Shots) -> Shots:
    return shots._replace(cameras=camera_paths.resized(shots.cameras, FLAGS.width, FLAGS.height))


def _images(folder: pathlib.Path, shots: Shots) -> Iterator[np.ndarray]:
    for name in shots.names:
        yield cv2.imread(str(folder / f"{name}.png"))[..., ::-1]


if __name__ == "__main__":
    app.run(main)
