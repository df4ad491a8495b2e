"""Flags that several programs share, and what they mean. No JAX is imported for `--help`."""

import pathlib
import sys
from typing import TYPE_CHECKING, Any

from absl import flags

from jaxcloseup.app.cli.topics import topic
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import DEFAULT, METHODS
from jaxcloseup.app.methods.settings import describe_settings, with_settings
from jaxcloseup.captures.choices import ALPHA_MODES, CHOICES, FORMATS, SPLITS


if TYPE_CHECKING:
    from jaxcloseup.app.store.stored_run import StoredRun

FLAGS = flags.FLAGS

with topic("What is trained") as _TRAINED:
    flags.DEFINE_enum(
        "method",
        DEFAULT,
        list(METHODS),
        "radiance field: "
        + "; ".join(f"{name}, {method.help}" for name, method in METHODS.items()),
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
        "score_width",
        None,
        "about how many pixels the longer side of held-out views has when they are scored; "
        "default: as the photographs, or 960 where these are larger than a screen",
        lower_bound=1,
    )
    flags.DEFINE_integer(
        "windows",
        None,
        "number of photographs' windows, and of pseudo-labels, in a training step; devices or CPU "
        "cores share them; default: the preset's",
        lower_bound=1,
    )
with topic("What is trained") as _SET:
    flags.DEFINE_multi_string(
        "set",
        [],
        "name=value changes a setting of the preset, as in --set label_loss_weight=0.1 or --set "
        "magnification=2:4; repeatable; --set=help lists all settings and their values",
    )
with topic("What is trained") as TIME:
    flags.DEFINE_float(
        "minutes",
        None,
        "train stage 1 for about so many minutes on this computer: steps are timed first, and the "
        "settings that repeat the training are printed; --resume goes on with these settings; "
        "default: as the preset says, and 10 of closeup",
        lower_bound=0.1,
    )
with topic("The capture") as _CAPTURE:
    flags.DEFINE_enum(
        "format",
        None,
        list(FORMATS),
        "format of the capture: transforms*.json, a COLMAP model or LLFF's poses_bounds.npy; "
        "default: the first of these in the folder",
    )
    flags.DEFINE_enum(
        "split",
        "given",
        list(SPLITS),
        "photographs to hold out: given: as the capture says, and every 8th where it says nothing; "
        "listed: as it says, and none where it says nothing; every8: every 8th by name, as "
        "test_far; closest: the closest tenth, as test, and every 8th of the rest, as test_far; "
        "macro: up to 16 wide ones train; all that are twice as near, as test, and every 8th of "
        "the rest, as test_far; "
        "zoom: every 8th, as test_far, and unreduced parts of some others, which train reduced "
        "--zoom times more, as test",
    )
    flags.DEFINE_integer(
        "zoom",
        None,
        "with --split=zoom: how many times finer test is than the training photographs; default: 4",
        lower_bound=2,
    )
    flags.DEFINE_integer(
        "photographs", None, "number of training photographs to use; default: all", lower_bound=2
    )
    flags.DEFINE_enum(
        "choose",
        "path",
        list(CHOICES),
        "with --photographs: which ones: path: evenly over their order; spread: from cameras that "
        "stand and look as far apart as possible; first: the first, as of a path along one side",
    )
    flags.DEFINE_bool("invert_masks", False, "read white in masks as pixels to ignore")
    flags.DEFINE_enum(
        "alpha_mode",
        "blend",
        list(ALPHA_MODES),
        "how to read transparent pixels: blend: over a white background; mask: as masked pixels; "
        "ignore: as opaque ones",
    )
with topic("The capture") as _PIXELS:
    flags.DEFINE_bool(
        "half_pixel", False, "the capture has pixel centers at integers: add 0.5 to cx, cy"
    )
with topic("The capture") as CHECK:
    flags.DEFINE_bool(
        "check", True, "check first whether poses, lenses and points fit the photographs"
    )
    flags.DEFINE_bool(
        "fix", False, "correct a known mistake that the check finds, such as inverse matrices"
    )
    flags.DEFINE_bool("allow_misfit", False, "train although poses do not fit the photographs")
with topic("The run") as _RUN:
    flags.DEFINE_string("run", None, "folder of a run")
    flags.DEFINE_string(
        "stage", None, "stage to render; default: closeup, else control, else baseline"
    )
    flags.DEFINE_string(
        "data", None, "folder of the run's capture, if the capture was moved since training"
    )
with topic("Results") as OUTPUT:
    flags.DEFINE_string(
        "output_dir",
        None,
        "folder for results, new or empty; default: outputs/<scene>/<method>/<date_time> of a run, "
        "<run>/videos/<date_time> of render, <run>/meshes/<date_time> of mesh, "
        "<run>/exports/<date_time> of export, and outputs/compare/<date_time> of compare; closeup "
        "goes on in outputs/<name>/closeup, or in the run's folder; process needs one",
    )
with topic("Results") as _RESULTS:
    flags.DEFINE_bool("resume", False, "resume the training that was cut off in --output_dir")
    flags.DEFINE_bool(
        "tensorboard", False, "also write event files for TensorBoard; needs the extra tensorboard"
    )
with topic("Computers") as COMPUTERS:
    flags.DEFINE_string(
        "compilation_cache",
        None,
        "folder that keeps compiled programs between runs; empty: no cache; default: under "
        "~/.cache",
    )
    flags.DEFINE_string(
        "lpips_weights",
        None,
        "folder of LPIPS weights: vgg16-*.pth with vgg.pth, or alexnet-*.pth with alex.pth; "
        "default: $JAXCLOSEUP_LPIPS, or PyTorch's cache",
    )
# Groups for `share`: of programs that train, and of those that load a stored run.
TRAINING = [*_TRAINED, *_SET, *_CAPTURE, *_PIXELS, *CHECK, *OUTPUT, *_RESULTS, *COMPUTERS]
CAPTURE = ["format", "half_pixel", "invert_masks", "alpha_mode"]  # how photographs are read
STORED_RUN = [*_RUN, *_SET]


def preset_from_flags() -> Preset:
    """Return the preset with the settings that flags change; `--set=help` ends the program.

    Raises:
      ValueError: one sentence that names the flag.
    """
    presets = METHODS[FLAGS.method].presets
    if FLAGS.preset not in presets:
        raise ValueError(
            f"--preset={FLAGS.preset} is not for --method={FLAGS.method}: choose "
            + ", ".join(presets)
        )
    preset = presets[FLAGS.preset]
    _help_settings(preset)
    return with_settings(preset, settings_from_flags())


def settings_from_flags() -> list[str]:
    """Return the settings, `name=value`, that `--set` and flags of their own change."""
    given = {
        "downscale": FLAGS.downscale,
        "score_width": FLAGS.score_width,
        "num_windows": FLAGS.windows,
    }
    flagged = [f"{name}={value}" for name, value in given.items() if value is not None]
    return [*FLAGS.set, *flagged]


def _help_settings(preset: Preset) -> None:
    if "help" in FLAGS.set:
        print(describe_settings(preset))
        sys.exit(0)


def names_from_flags() -> dict[str, str]:
    """Return what tells runs apart beside their configuration, for reports and checkpoints."""
    return {"method": FLAGS.method, "preset": FLAGS.preset} | _changed_capture_flags()


def load_options_from_flags(preset: Preset) -> dict[str, Any]:
    """Return what `load_scene` takes beside a scene's name."""
    options = {name: FLAGS[name].value for name in ("half_pixel", "format", "split")}
    sized = {"downscale": preset.downscale}
    if preset.downscale is None:
        sized["pixels"] = preset.step_pixels
    return {**sized, **options, **_changed_capture_flags()}


def checked_from_flags(
    scene: str, options: dict[str, Any]
) -> "tuple[dict[str, Any], dict[str, Any] | None]":
    """Check a capture as the flags say; return its options with corrections, and what was found.

    Raises:
      SceneError: the capture cannot be read, or its poses do not fit.
    """
    from jaxcloseup.app.run.capture_check import fitting_options

    if not FLAGS.check:
        return options, None
    return fitting_options(scene, options, fix=FLAGS.fix, allow_misfit=FLAGS.allow_misfit)


def _changed_capture_flags() -> dict[str, Any]:
    """Return the flags about the capture that are not at their defaults."""
    changed = [name for name in _CAPTURE if FLAGS[name].value != FLAGS[name].default]
    return {name: FLAGS[name].value for name in changed}


def run_from_flags() -> "tuple[StoredRun, str]":
    """Return the run that `--run` names, with the settings of `--set`, and the stage to render.

    `--set=help` ends the program instead.

    Raises:
      RunError: the run, the stage or a setting does not exist.
    """
    from jaxcloseup.app.store import stored_run

    if FLAGS.run is None:
        raise stored_run.RunError("--run is missing: name the folder of a run")
    run = stored_run.read_run(pathlib.Path(FLAGS.run))
    _help_settings(run.preset)
    return stored_run.change_settings(run, FLAGS.set), stored_run.choose_stage(run, FLAGS.stage)
