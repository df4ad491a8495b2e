"""Flags of the programs that train, and what they say together."""

import dataclasses
import datetime
import os
import pathlib

from absl import flags

from experiments.output_dir import check_unused
from experiments.presets import PRESETS, Preset, with_classic_density


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
flags.DEFINE_float(
    "colour_ridge",
    None,
    "let each photograph change the colours of surfels by an affine map while training, against "
    "this resistance, say 0.01; default: no such change",
    lower_bound=0.0,
)
flags.DEFINE_bool(
    "half_pixel", False, "the capture has pixel centres at integers: add 0.5 to cx, cy"
)
_OF_METHOD = {"nerf": ("compute_dtype",), "surfels": ("density", "colour_ridge")}


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
        field = dataclasses.replace(preset.field, colour_ridge=FLAGS.colour_ridge)
        if FLAGS.density == "classic":
            field = with_classic_density(field, FLAGS.preset)
        given["field"] = field
    return dataclasses.replace(preset, **given)


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
