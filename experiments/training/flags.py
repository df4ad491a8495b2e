"""Flags of the programs that train, and what they say together."""

import dataclasses
import datetime
import os
import pathlib
from collections.abc import Mapping
from typing import Any

from absl import flags

from experiments.command_line import check_unused
from experiments.methods.presets import PRESETS, Preset, with_classic_density
from jaxcloseup.captures.formats import FORMATS
from jaxcloseup.captures.photo_reading import ALPHA_MODES
from jaxcloseup.captures.splits import SPLITS
from jaxcloseup.scenes import Scene, load_scene


FLAGS = flags.FLAGS
flags.DEFINE_enum("method", "surfels", list(PRESETS), "radiance field")
flags.DEFINE_enum(
    "preset",
    "quick",
    ["quick", "paper", "released"],
    "hyper-parameters; flags below override them; released: of NeRF alone",
)
flags.DEFINE_integer(
    "downscale",
    None,
    "reduce photographs by this factor, by area; default: the preset's",
    lower_bound=1,
)
flags.DEFINE_integer(
    "baseline_steps", None, "steps of stage 1; default: the preset's", lower_bound=1
)
flags.DEFINE_integer(
    "closeup_steps", None, "steps of closeup and of control; default: the preset's", lower_bound=1
)
flags.DEFINE_bool("resume", False, "go on with the run in --output_dir where it was cut off")
flags.DEFINE_bool(
    "tensorboard", False, "also write event files for TensorBoard; needs the extra tensorboard"
)
flags.DEFINE_enum(
    "compute_dtype",
    "float32",
    ["float32", "bfloat16"],
    "operands of the products of a NeRF's network; bfloat16 is faster and less exact",
)
flags.DEFINE_enum(
    "density",
    "mcmc",
    ["mcmc", "classic"],
    "how surfels are added: Monte Carlo moves, or clone, split and prune",
)
flags.DEFINE_integer(
    "capacity", None, "most surfels there can be; default: the preset's", lower_bound=1
)
flags.DEFINE_float(
    "color_ridge",
    None,
    "let each photograph change the colors of surfels by an affine map while training, against "
    "this resistance, say 0.01; default: no such change",
    lower_bound=0.0,
)
flags.DEFINE_bool(
    "half_pixel", False, "the capture has pixel centers at integers: add 0.5 to cx, cy"
)
flags.DEFINE_enum(
    "format",
    None,
    list(FORMATS),
    "what to read of a capture's folder: transforms*.json, a COLMAP model or LLFF's "
    "poses_bounds.npy; default: the first of them that is there",
)
flags.DEFINE_enum(
    "split",
    "given",
    list(SPLITS),
    "photographs that are held out: as the capture says; every 8th by name, as test_far; the "
    "closest tenth, as test, and of the rest every 8th; zoom: every 8th, as test_far, while the "
    "rest is reduced --zoom times more, and parts of some of these that are not reduced, as test",
)
flags.DEFINE_integer(
    "zoom",
    None,
    "of --split=zoom: how many times finer than the training photographs test is; default: 4",
    lower_bound=2,
)
flags.DEFINE_bool("invert_masks", False, "masks are white where photographs are to be ignored")
flags.DEFINE_enum(
    "alpha_mode",
    "blend",
    list(ALPHA_MODES),
    "transparent pixels of photographs show a white background, or weigh as a mask does",
)
_OF_CAPTURE = ("format", "split", "zoom", "invert_masks", "alpha_mode")
_OF_METHOD = {"nerf": ("compute_dtype",), "surfels": ("density", "capacity", "color_ridge")}


def preset_from_flags() -> Preset:
    """The preset, with the flags that were given in place of its values."""
    of_method = PRESETS[FLAGS.method]
    if FLAGS.preset not in of_method:
        raise ValueError(
            f"--preset={FLAGS.preset} is not for --method={FLAGS.method}: choose "
            + " or ".join(of_method)
        )
    for method, names in _OF_METHOD.items():
        for name in names:
            if method != FLAGS.method and FLAGS[name].value != FLAGS[name].default:
                raise ValueError(f"--{name} is for --method={method}: leave it out")
    preset = of_method[FLAGS.preset]
    given = {
        name: getattr(FLAGS, name)
        for name in ("downscale", "baseline_steps", "closeup_steps")
        if getattr(FLAGS, name) is not None
    }
    if FLAGS.method == "nerf":
        given["field"] = dataclasses.replace(preset.field, compute_dtype=FLAGS.compute_dtype)
    else:
        capacity = FLAGS.capacity or preset.field.capacity
        field = dataclasses.replace(preset.field, capacity=capacity, color_ridge=FLAGS.color_ridge)
        if FLAGS.density == "classic":
            field = with_classic_density(field, FLAGS.preset)
        given["field"] = field
    return dataclasses.replace(preset, **given)


def names_from_flags() -> dict[str, str]:
    """What tells runs apart beside their configuration, for reports and checkpoints."""
    names = {"method": FLAGS.method, "preset": FLAGS.preset}
    return names | _given(*_OF_CAPTURE)


def load_options_from_flags(preset: Preset) -> dict[str, Any]:
    """What `load_scene` is given beside a scene's name."""
    options = {name: FLAGS[name].value for name in ("half_pixel", "format", "split")}
    return {"downscale": preset.downscale, **options, **_given(*_OF_CAPTURE)}


def _given(*names: str) -> dict[str, Any]:
    """The flags of these that are not at their defaults."""
    return {name: FLAGS[name].value for name in names if FLAGS[name].value != FLAGS[name].default}


def load(name: str, options: Mapping[str, Any]) -> Scene:
    """A built-in scene or a capture, with a printed note on what of it was read.

    Raises:
      SceneError: one sentence that says what to do.
    """
    scene = load_scene(name, **options)
    for note in scene.metadata.get("notes", ()):
        print(note)
    return scene


def choose_output_dir(
    folder: str | None, scene: str, method: str, *, resume: bool = False
) -> pathlib.Path:
    """The output folder; never one that holds something, unless that is to be resumed."""
    if resume:
        if folder is None or not (pathlib.Path(folder) / "checkpoints").is_dir():
            raise FileNotFoundError(
                f"--resume finds no run in --output_dir={folder or ''}: name the folder of one "
                "that was cut off"
            )
        return pathlib.Path(folder)
    if folder is None:
        stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
        folder = os.path.join("outputs", pathlib.Path(scene).name, method, stamp)
    return check_unused(folder)
