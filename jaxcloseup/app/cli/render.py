"""Render a finished or interrupted run: its views, a camera path, an orbit or a dolly.

    python -m experiments.render --run=outputs/table/surfels/... --views=test
    python -m experiments.render --run=... --camera_path=camera_path.json [--fine_tune]
    python -m experiments.render --run=... --orbit --frames=120
    python -m experiments.render --run=... --from=train_003 --pixel=60,40 --magnification=4

The program writes a folder of images for each of `rgb`, `depth`, `normals` (surfels only),
`support`, which shows how many training photographs saw each pixel and how sharply, `trust`, how
much of their detail was added to `rgb`, and `error`, by how much colors are expected to be off;
`--nodetail` shows the field alone. Except for `--views`, it also writes each folder as a video. A
dolly moves from a training view straight towards the surface at a pixel. `--fine_tune` first trains
for exactly the rendered cameras, on pseudo-labels made for them; `--target=FILE` is short for
`--camera_path=FILE --fine_tune`.
"""

from absl import flags

from jaxcloseup.app.cli import view_flags as define_flags
from jaxcloseup.app.cli.start import job


flags.adopt_module_key_flags(define_flags)  # these are in --help too
flags.declare_key_flag("output_dir")
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
    "up",
    None,
    "x,y,z: the world's up direction in --orbit; default: as the capture says, else as its level "
    "cameras say; give it where an orbit is tilted",
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


def main(_: list[str]) -> None:
    """Render the cameras that the flags choose."""
    job("render").main()
