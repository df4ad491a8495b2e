"""Flags of the programs that train.

`--help` must not wait for JAX, so no module that defines flags imports it.
"""

from absl import flags

from jaxcloseup.app.cli import set_flag
from jaxcloseup.app.methods.registry import DEFAULT, METHODS
from jaxcloseup.captures.choices import ALPHA_MODES, FORMATS, SPLITS


flags.adopt_module_key_flags(set_flag)
flags.DEFINE_enum(
    "method",
    DEFAULT,
    list(METHODS),
    "radiance field: " + "; ".join(f"{name}, {method.help}" for name, method in METHODS.items()),
)
flags.DEFINE_enum(
    "preset",
    "quick",
    list(dict.fromkeys(name for method in METHODS.values() for name in method.presets)),
    "hyper-parameters: "
    + "; ".join(f"{name} has {', '.join(method.presets)}" for name, method in METHODS.items()),
)
flags.DEFINE_integer(
    "downscale",
    None,
    "divide the size of photographs by this, averaging areas; default: the preset's",
    lower_bound=1,
)
flags.DEFINE_integer(
    "windows",
    None,
    "windows of photographs that a step learns from, and pseudo-labels, shared out among devices, "
    "or among the cores of a CPU; default: the preset's",
    lower_bound=1,
)
flags.DEFINE_bool("resume", False, "resume the training that was cut off in --output_dir")
flags.DEFINE_bool(
    "tensorboard", False, "also write event files for TensorBoard; needs the extra tensorboard"
)
flags.DEFINE_bool(
    "half_pixel", False, "the capture has pixel centers at integers: add 0.5 to cx, cy"
)
flags.DEFINE_enum(
    "format",
    None,
    list(FORMATS),
    "read this from the capture's folder: transforms*.json, a COLMAP model or LLFF's "
    "poses_bounds.npy; default: the first of them that the folder holds",
)
flags.DEFINE_enum(
    "split",
    "given",
    list(SPLITS),
    "photographs to hold out: given: as the capture says; every8: every 8th by name, as test_far; "
    "closest: the closest tenth, as test, and every 8th of the rest, as test_far; zoom: every 8th, "
    "as test_far, and unreduced parts of some others, which train reduced --zoom times more, as "
    "test",
)
flags.DEFINE_integer(
    "zoom",
    None,
    "with --split=zoom: how many times finer test is than the training photographs; default: 4",
    lower_bound=2,
)
flags.DEFINE_integer(
    "photographs",
    None,
    "learn from so many of the training photographs, evenly spread over their order; default: all",
    lower_bound=2,
)
flags.DEFINE_bool("invert_masks", False, "masks are white where photographs do not count")
flags.DEFINE_enum(
    "alpha_mode",
    "blend",
    list(ALPHA_MODES),
    "blend: transparent pixels show a white background; mask: they weigh as a mask does",
)
