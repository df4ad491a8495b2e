"""Render a finished or cut-off run: its views, a camera path, an orbit or a dolly, as a video.

    python -m experiments.render --run=outputs/table/surfels/... --views=test
    python -m experiments.render --run=... --camera_path=camera_path.json [--fine_tune]
    python -m experiments.render --run=... --orbit --frames=120
    python -m experiments.render --run=... --from=train_003 --pixel=60,40 --magnification=4

A dolly goes from a training view straight towards the surface at a pixel. Beside colour and depth
there are normals, of surfels, and `support`: how many training photographs saw a pixel, and how
sharply. `--fine_tune` first trains for exactly these cameras, with labels made for them;
`--target=FILE` is `--camera_path=FILE --fine_tune`.
"""

import datetime
import functools
import math
import pathlib
import sys
from collections.abc import Iterator, Sequence

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from experiments import camera_paths
from experiments.camera_paths import CameraError, Shots
from experiments.finished import RunError, choose_stage, load_run_scene, read_run, restore
from experiments.gate import print_gate, weigh_labels
from experiments.loop import Programs, TrainingError
from experiments.output_dir import check_unused
from experiments.pipeline import training_depths
from experiments.presets import pseudo_settings
from experiments.set_up import set_up
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.artifacts.images import (
    colorize_depth,
    colorize_normals,
    colorize_support,
    write_png,
)
from jaxcloseup.artifacts.video import write_video
from jaxcloseup.batch import camera_at
from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.geometry.union_warp import block_sources
from jaxcloseup.pseudo import label_views
from jaxcloseup.scenes import Scene, SceneError
from jaxcloseup.splats.field import SurfelConfig
from jaxcloseup.support import find_support
from jaxcloseup.train import TrainState, labelled_depth


FLAGS = flags.FLAGS
flags.declare_key_flag("output_dir")
flags.DEFINE_string("run", None, "folder of the run")
flags.DEFINE_string("stage", None, "which state to render; default: closeup, or the last there is")
flags.DEFINE_string("data", None, "where the run's capture lies now, if it was moved")
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
    if FLAGS.run is None:
        raise RunError("--run is missing: name the folder of a run of experiments.run")
    record = read_run(pathlib.Path(FLAGS.run))
    stage = choose_stage(record, FLAGS.stage)
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
        seen = labelled_depth(programs.render(state, view), near=0, far=scene.far)
        depth = float(seen[row, column])
        if depth <= 0:
            raise CameraError(
                f"--pixel={','.join(FLAGS.pixel)} of {FLAGS['from'].value} has no depth, for the "
                f"{stage} shows no surface there: choose another pixel"
            )
        motion = {"magnification": FLAGS.magnification, "frames": FLAGS.frames}
        shots = _resized(camera_paths.dolly(view, pixel, depth, **motion))
    fine_tuned = FLAGS.fine_tune or FLAGS.target is not None
    depths = None
    if FLAGS.support or fine_tuned:
        depths = training_depths(programs, state, record.identity["seed"])
    if fine_tuned:
        state = fine_tune(programs, state, depths, shots, most=FLAGS.target_steps)
    seen_from = depths if FLAGS.support else None
    folders = render_shots(output_dir, programs, state, shots, depths=seen_from)
    print(f"{len(shots.names)} frames: {', '.join(str(folder) for folder in folders)}")
    if way != "views" and len(shots.names) > 1:
        for folder in folders:
            path = write_video(folder, _images(folder, shots), fps=FLAGS.fps or shots.fps or 30.0)
            print(f"video: {path}")
        if path.suffix != ".mp4":
            print('MP4 needs imageio-ffmpeg: install jaxcloseup with the extra "video"')


def fine_tune(
    programs: Programs, state: TrainState, depths: jax.Array, shots: Shots, *, most: int | None
) -> TrainState:
    """Train a state for the cameras that are to be rendered, with labels made once for them.

    Where the preset has a gate, it weighs the labels again.

    Args:
      programs: of the run.
      state: of which depth is rendered for the labels.
      depths: `[V, H, W]` of the training views, of this state.
      shots: the cameras.
      most: steps in all; by default the preset's, for each camera of surfels.
    """
    preset, scene = programs.preset, programs.scene
    render = functools.partial(programs.render, state)
    settings, views = pseudo_settings(preset), scene.train
    if preset.gated:
        settings, found = weigh_labels(views, depths, render, settings)
        print_gate(found)
        if not found["weight"]:
            print("nothing is fine-tuned")
            return state
    # Targets may be nearer to the surface than any photograph was.
    seen = (render(camera) for _, camera in camera_paths.one_by_one(shots))
    targets = jnp.stack([labelled_depth(one, near=0, far=scene.far) for one in seen])
    sources = jax.jit(block_sources)(views.cameras, depths, views.weight)
    data = shots.cameras, targets, views, depths, settings
    labels = jax.jit(label_views)(*data, sources=sources)
    steps = preset.test_time_steps
    if isinstance(preset.field, SurfelConfig):
        steps *= len(shots.names)
    steps = min(steps, most or steps)
    coverage = float(jnp.mean(labels.weight))
    print(f"labels on {coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True)
    if coverage == 0:
        print("nothing is fine-tuned")
        return state
    state, values = programs.run("targets", state, views, labels, settings, count=steps)
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    print("  ".join(f"{key} {value:.4g}" for key, value in numbers.items()))
    return state


def render_shots(
    output_dir: pathlib.Path,
    programs: Programs,
    state: TrainState,
    shots: Shots,
    *,
    depths: jax.Array | None,
) -> list[pathlib.Path]:
    """Write `<kind>/<name>.png` for every camera; returns the folders.

    Args:
      output_dir: for `rgb`, `depth`, `normals` of surfels, and `support`.
      programs: of the run.
      state: what is rendered.
      shots: cameras.
      depths: `[V, H, W]` of the training views, or None for no support.
    """
    scene = programs.scene
    support = jax.jit(find_support)
    kinds: list[str] = []
    cameras = camera_paths.one_by_one(shots)
    # Depth has the colours of three frames in all of them, so that videos do not flicker.
    some = [programs.render(state, cameras[i][1]) for i in {0, len(cameras) // 2, len(cameras) - 1}]
    limits = depth_range([labelled_depth(one, near=0, far=scene.far) for one in some], scene)
    for name, camera in cameras:
        seen = programs.render(state, camera)
        solid = np.asarray(seen.alpha) >= 0.5
        depth_colours = colorize_depth(seen.depth, near=limits[0], far=limits[1], valid=solid)
        images = {"rgb": seen.rgb, "depth": depth_colours}
        surfels = getattr(seen.aux, "surfels", None)
        if surfels is not None:
            images["normals"] = colorize_normals(np.where(solid[..., None], surfels.normal, 0))
        if depths is not None:
            depth = labelled_depth(seen, near=0, far=scene.far)
            pixels = pixel_grid(camera.height, camera.width)
            found = support(camera, pixels, depth, scene.train, depths)
            images["support"] = colorize_support(*found)
        for kind, image in images.items():
            write_png(output_dir / kind / f"{name}.png", image)
        kinds = list(images)
    return [output_dir / kind for kind in kinds]


def depth_range(depths: Sequence[jax.Array], scene: Scene) -> tuple[float, float]:
    """Near and far of most of these depths, 0 being undefined, or else the scene's."""
    known = np.concatenate([np.asarray(depth).ravel() for depth in depths])
    known = known[known > 0]
    if not len(known):
        return scene.near, scene.far
    low, high = np.percentile(known, [1, 99])
    return float(low), float(high)


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
