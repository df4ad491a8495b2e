"""The preset, the settings and the capture that the flags of the programs that train describe."""

import datetime
import os
import pathlib
import sys
from collections.abc import Mapping
from typing import Any

from absl import flags

from jaxcloseup.app.cli.start import CHECKPOINTS, check_unused
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import describe_settings, with_settings
from jaxcloseup.captures.load import load_scene
from jaxcloseup.metrics.image_metrics import SSIM_TAPS
from jaxcloseup.photos.scene import Scene, SceneError


FLAGS = flags.FLAGS
_OF_CAPTURE = ("format", "split", "zoom", "photographs", "invert_masks", "alpha_mode")


def preset_from_flags() -> Preset:
    """The preset with the settings that flags change; ends the program after `--set=help`.

    Raises:
      ValueError: one sentence that names the flag.
    """
    presets = METHODS[FLAGS.method].presets
    if FLAGS.preset not in presets:
        raise ValueError(
            f"--preset={FLAGS.preset} is not for --method={FLAGS.method}: choose "
            + ", ".join(presets)
        )
    if "help" in FLAGS.set:
        print(describe_settings(presets[FLAGS.preset]))
        sys.exit(0)
    given = {"downscale": FLAGS.downscale, "num_windows": FLAGS.windows}
    flagged = [f"{name}={value}" for name, value in given.items() if value is not None]
    return with_settings(presets[FLAGS.preset], [*FLAGS.set, *flagged])


def names_from_flags() -> dict[str, str]:
    """What tells runs apart beside their configuration, for reports and checkpoints."""
    return {"method": FLAGS.method, "preset": FLAGS.preset} | _given(*_OF_CAPTURE)


def load_options_from_flags(preset: Preset) -> dict[str, Any]:
    """What `load_scene` takes beside a scene's name."""
    options = {name: FLAGS[name].value for name in ("half_pixel", "format", "split")}
    return {"downscale": preset.downscale, **options, **_given(*_OF_CAPTURE)}


def _given(*names: str) -> dict[str, Any]:
    """Values of these flags, but for those at their defaults."""
    return {name: FLAGS[name].value for name in names if FLAGS[name].value != FLAGS[name].default}


def load(name: str, options: Mapping[str, Any]) -> Scene:
    """A built-in scene or a capture; prints what was read of it.

    Raises:
      SceneError: one sentence that says what to do, also of photographs too small for SSIM.
    """
    scene = load_scene(name, **options)
    own = (scene.train.cameras.width, scene.train.cameras.height)
    sizes = scene.metadata.get("sizes", {"train": [own]})
    width, height = min((size for part in sizes.values() for size in part), key=min)
    if min(width, height) < SSIM_TAPS:
        raise SceneError(
            f"{name}: a photograph has {width} x {height} pixels, but SSIM needs {SSIM_TAPS} a "
            "side: choose a smaller --downscale or --zoom, or larger photographs."
        )
    for note in scene.metadata.get("notes", ()):
        print(note)
    return scene


def choose_output_dir(
    folder: str | None, scene: str, method: str, *, resume: bool = False
) -> pathlib.Path:
    """The output folder; never one that holds something, unless its training is to be resumed."""
    if resume:
        if folder is None or not (pathlib.Path(folder) / CHECKPOINTS).is_dir():
            raise FileNotFoundError(
                f"--resume finds no run in --output_dir={folder or ''}: name the folder of one "
                "that was cut off"
            )
        return pathlib.Path(folder)
    if folder is None:
        stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
        own_name = os.path.basename(os.path.realpath(scene))  # of `..` too
        folder = os.path.join("outputs", own_name, method, stamp)
    if (pathlib.Path(folder) / CHECKPOINTS).is_dir():
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: resume its training with "
            "--resume, or name a new folder"
        )
    return check_unused(folder)
