"""Render a finished or interrupted run: its views, a camera path, an orbit or a dolly.

    jaxcloseup render --run=outputs/table/surfels/... --views=test
    jaxcloseup render --run=... --camera_path=camera_path.json [--fine_tune]
    jaxcloseup render --run=... --orbit --frames=120
    jaxcloseup render --run=... --from=train_003 --pixel=60,40 --magnification=4

The program writes a folder of images for each of `rgb`, `depth`, `normals` (surfels only),
`support`, which shows how many training photographs saw each pixel and how sharply, `trust`, how
much of their detail was added to `rgb`, and `error`, by how much colors are expected to be off;
`--nodetail` shows the field alone. Except for `--views`, it also writes each folder as a video. A
dolly moves from a training view straight towards the surface at a pixel. `--fine_tune` first trains
for exactly the rendered cameras, on pseudo-labels made for them; `--target=FILE` is short for
`--camera_path=FILE --fine_tune`.
"""

import math
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from absl import flags

from jaxcloseup.app.cli.flags import OUTPUT, STORED_RUN, run_from_flags
from jaxcloseup.app.cli.output_folder import check_unused, dated, prepare_to_stop
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share, topic


if TYPE_CHECKING:
    from jaxcloseup.app.view.camera_paths import Shots
    from jaxcloseup.photos.scene import Scene

FLAGS = flags.FLAGS
share(STORED_RUN, OUTPUT)
with topic("Cameras"):
    flags.DEFINE_string("views", None, "split whose cameras to render: test, test_far or train")
    flags.DEFINE_string("camera_path", None, "camera_path.json whose cameras to render")
    flags.DEFINE_string(
        "camera_transform",
        None,
        "dataparser_transforms.json of the nerfstudio run in which the camera path was made; it "
        "maps the path back to the capture's coordinates; default: the path is already in them",
    )
    flags.DEFINE_string("target", None, "short for --camera_path with --fine_tune")
    flags.DEFINE_bool(
        "orbit", False, "render an orbit around the point that the training cameras look at"
    )
    flags.DEFINE_list(
        "up",
        None,
        "x,y,z: the world's up direction in --orbit; default: as the capture says, else as its "
        "level cameras say; give it where an orbit is tilted",
    )
    flags.DEFINE_string("from", None, "training view from which to render a dolly towards --pixel")
    flags.DEFINE_list("pixel", None, "x,y: pixel of the --from photograph at its own size")
    flags.DEFINE_float("magnification", 4.0, "how many times nearer to the surface a dolly ends")
    flags.DEFINE_integer(
        "frames", 60, "number of frames of an orbit or a dolly", lower_bound=1, upper_bound=100_000
    )
    flags.DEFINE_float(
        "fps", None, "frames per second of the video; default: the camera path's, or 30"
    )
    flags.DEFINE_integer(
        "width",
        None,
        "width of images in pixels; default: from --height or --scale, or the photographs' own",
        lower_bound=1,
        upper_bound=2**31 - 1,
    )
    flags.DEFINE_integer(
        "height",
        None,
        "height of images in pixels; default: from --width or --scale, or the photographs' own",
        lower_bound=1,
        upper_bound=2**31 - 1,
    )
    flags.DEFINE_float(
        "scale", None, "size of images as a multiple of the photographs' own, such as 0.5"
    )
with topic("Pictures"):
    flags.DEFINE_bool(
        "fine_tune", False, "first fine-tune for exactly the cameras that are rendered"
    )
    flags.DEFINE_integer(
        "target_steps", None, "maximum steps of --fine_tune; default: the preset's", lower_bound=1
    )
    flags.DEFINE_bool(
        "support", True, "also render support, which needs the depth of every training photograph"
    )
    flags.DEFINE_bool(
        "detail",
        True,
        "add the detail that the photographs show beyond the field; made once for a run",
    )
    flags.DEFINE_string(
        "exposure",
        "auto",
        "exposure of images, where photographs differ in theirs: auto, as the camera chose it, "
        "or would have chosen; middle, the mean of all photographs; or the name of a photograph",
    )
# Flags that only these camera sources accept.
_ONLY_WITH = {
    "frames": ("orbit", "from"),
    **dict.fromkeys(("width", "height", "scale"), ("views", "orbit", "from")),
    **dict.fromkeys(("pixel", "magnification"), ("from",)),
    "fps": ("camera_path", "target", "orbit", "from"),  # views are no video
    "up": ("orbit",),
    "camera_transform": ("camera_path", "target"),
}


def main(_: list[str]) -> None:
    """Render the cameras that the flags choose."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.store.stored_run import RunError
        from jaxcloseup.app.view.camera_paths import CameraError
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    expected = (RunError, CameraError, SceneError, CheckpointError, TrainingError, OSError)
    with in_one_sentence("render", *expected), progress.showing():
        _render()


def _render() -> None:
    from jaxcloseup.app.store.stored_run import load_run_scene
    from jaxcloseup.app.view.rendering import render_run, write_videos

    # Cheap checks come before loading the scene and the state.
    source = _camera_source()
    record, stage = run_from_flags()
    output_dir = check_unused(FLAGS.output_dir or dated(record.folder / "videos"))
    prepare_to_stop(output_dir)
    scene, make_shots = _cameras(source, lambda: load_run_scene(record, FLAGS.data))
    shots, folders = render_run(
        output_dir,
        record,
        scene,
        stage,
        make_shots,
        support=FLAGS.support,
        detail=FLAGS.detail,
        fine_tuned=FLAGS.fine_tune or FLAGS.target is not None,
        most_steps=FLAGS.target_steps,
        exposure=FLAGS.exposure,
    )
    if source != "views" and len(shots.names) > 1:
        write_videos(shots, folders, fps=FLAGS.fps or shots.fps or 30.0)


def _cameras(
    source: str, load: "Callable[[], Scene]"
) -> "tuple[Scene, Callable[[Any, Any], Shots]]":
    """Return the scene, and a function of a trained state that makes the cameras."""
    from jaxcloseup.app.view import camera_files, camera_paths
    from jaxcloseup.app.view.rendering import dolly_towards

    if source in ("camera_path", "target"):
        shots = camera_files.read_camera_path(pathlib.Path(FLAGS.target or FLAGS.camera_path))
        file = FLAGS.camera_transform
        transform = camera_files.read_camera_transform(pathlib.Path(file)) if file else None
        scene = load()
        if transform is not None:
            shots = camera_files.to_capture(shots, *transform, scene)
        shots = camera_files.to_scene(shots, scene)
        return scene, lambda programs, state: shots
    scene = load()
    if source == "from":
        return scene, dolly_towards(
            scene,
            str(FLAGS["from"].value),
            _pixel(),
            magnification=FLAGS.magnification,
            frames=FLAGS.frames,
            resize=_resize,
        )
    if source == "views":
        shots = camera_paths.view_shots(scene, FLAGS.views)
    else:
        shots = camera_paths.orbit(scene, FLAGS.frames, up=_up())
    shots = _resize(shots)
    return scene, lambda programs, state: shots


def _resize(shots: "Shots") -> "Shots":
    from jaxcloseup.app.view.camera_paths import resized_shots

    return resized_shots(shots, FLAGS.width, FLAGS.height, FLAGS.scale)


def _camera_source() -> str:
    """Check the flags; return the one that chooses the cameras."""
    from jaxcloseup.app.view.camera_paths import CameraError

    sources = ("views", "camera_path", "target", "orbit", "from")
    given = [source for source in sources if FLAGS[source].value]
    if len(given) != 1:
        raise CameraError(
            "give exactly one of --views, --camera_path, --target, --orbit and --from, not "
            + (" and ".join(f"--{source}" for source in given) or "none")
        )
    for flag, accepting in _ONLY_WITH.items():
        if FLAGS[flag].value != FLAGS[flag].default and given[0] not in accepting:
            raise CameraError(f"--{flag} does not apply to --{given[0]}: leave it out")
    if FLAGS.target_steps is not None and not (FLAGS.fine_tune or given[0] == "target"):
        raise CameraError("--target_steps needs --fine_tune or --target: leave it out, or add one")
    if FLAGS.scale is not None and not (
        0 < FLAGS.scale < float("inf") and FLAGS.width is None and FLAGS.height is None
    ):
        raise CameraError(f"--scale={FLAGS.scale:g} must be above 0, without --width and --height")
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
    from jaxcloseup.app.view.camera_paths import CameraError

    try:
        x, y = map(float, FLAGS.pixel or ())
    except ValueError:
        raise CameraError(
            "--from needs --pixel=x,y: give a pixel of that view as two numbers"
        ) from None
    return x, y


def _up() -> tuple[float, ...] | None:
    from jaxcloseup.app.view.camera_paths import CameraError

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
