"""Load a scene: a drawn one by name, or a capture by its folder.

The first of these that a folder holds is read:

- `transforms_train.json`, with optional `transforms_test.json` (split `test`) and
  `transforms_test_far.json` or Blender's `transforms_val.json` (split `test_far`);
- `transforms.json` from Instant-NGP or nerfstudio, with its lists of file names by split;
- a COLMAP model, binary or text, the largest in `sparse/0`, `sparse/1`, ..., or in `sparse` or
  `colmap/sparse/0`, with photographs in `images`; the path may also name the model's own folder;
- LLFF's `poses_bounds.npy`, with photographs in `images`.

Lenses are undistorted to pinhole cameras of the same size; photographs of different sizes are
padded with weight 0. Points come from the model, a PLY file, or triangulated features.
"""

import pathlib
from collections.abc import Sequence

import numpy as np

from jaxcloseup.captures import ALPHA_MODES, CHOICES, FORMATS, SPLITS, Reading, load_capture
from jaxcloseup.captures.choosing import choose_photographs
from jaxcloseup.captures.formats import fitting_divisor
from jaxcloseup.drawn_scenes import DRAWN_SCENES, draw_scene
from jaxcloseup.drawn_scenes.drawn import HEIGHT, WIDTH
from jaxcloseup.photos.scene import Scene, SceneError, SceneWarning, Surface, keep_photographs


__all__ = ["DRAWN_SCENES", "Scene", "SceneError", "SceneWarning", "Surface", "load_scene"]

_DEFAULT_ZOOM = 4


def load_scene(
    name_or_path: str | pathlib.Path,
    *,
    downscale: int | None = 1,
    pixels: int = 8192,
    half_pixel: bool = False,
    background: float = 1.0,
    format: str | None = None,
    split: str = "given",
    zoom: int | None = None,
    invert_masks: bool = False,
    alpha_mode: str = "blend",
    photographs: int | None = None,
    choose: str = "path",
    corrections: Sequence[str] = (),
) -> Scene:
    """Load a drawn scene by its name, or a capture from its folder.

    The module's docstring says which files are read, and docs/programs.md describes splits, masks
    and limits.

    Args:
      name_or_path: one of `DRAWN_SCENES`, or a folder; `./table` always names a folder.
      downscale: divisor of the photographs' size, by averaging areas; None: chosen by `pixels`.
      pixels: about how many pixels photographs keep.
      half_pixel: whether the files put pixel centers at integers, as the paper's script does.
      background: gray level in [0, 1] behind transparent pixels.
      format: the only format to read, `transforms`, `colmap` or `llff`; None reads the first found.
      split: how to hold out photographs: one of `SPLITS`, as docs/programs.md describes them.
      zoom: how many times finer `test` is with split `zoom`, 2 or more; None means 4.
      invert_masks: whether masks mark ignored pixels in white instead of black.
      alpha_mode: `blend` shows the background through transparent pixels; `mask` keeps the file's
        colors and uses alpha as the weight; `ignore` keeps them and drops alpha.
      photographs: keep so many training photographs; None means all.
      choose: which of them: `path` takes them evenly over their order, `spread` from cameras that
        stand and look as far apart as possible, `first` the first, which see one side.
      corrections: corrections of known mistakes, as `captures.corrections` lists them.

    Returns:
      The scene, float32, in coordinates of its own, which `placement` maps to those of a folder's
      files. For a folder, `metadata` holds path, downscale, zoom, format, split; files and sizes
      (width, height) by split; applied_transform `[3, 4]`, applied_scale; up `[3]` or None; notes
      on what was read; times_nearer of `test` views, if the split knows; corners of `zoom`'s crops.

    Raises:
      SceneError: one sentence that names the file and the field and says what to do.
    """
    _check_options(downscale, background, format, split, zoom, alpha_mode)
    _check_choice(photographs, choose)
    zoom = (zoom or _DEFAULT_ZOOM) if split == "zoom" else 1
    wanted = None if downscale else pixels
    path = pathlib.Path(name_or_path)
    if is_drawn(name_or_path):
        _check_drawn(path.name, format, split, invert_masks, alpha_mode)
        return _draw(path.name, downscale, pixels, photographs, choose)
    check_exists(path)
    reading = Reading(downscale or 1, zoom, background, half_pixel, alpha_mode, invert_masks)
    chosen = {"format": format, "split": split, "photographs": photographs, "choose": choose}
    return load_capture(path, reading, pixels=wanted, corrections=corrections, **chosen)


def check_exists(path: pathlib.Path) -> None:
    """Raise a `SceneError` for a name that is neither a folder's nor a built-in scene's."""
    if len(path.parts) == 1 and not path.exists():
        raise SceneError(
            f"{path} is neither a folder nor a built-in scene: choose one of "
            f"{', '.join(DRAWN_SCENES)}, or give the path of a capture."
        )


def is_drawn(name_or_path: str | pathlib.Path) -> bool:
    """Return True for the name of a built-in scene; `./table` names a folder."""
    return str(name_or_path) in DRAWN_SCENES


def _draw(
    name: str, downscale: int | None, pixels: int, photographs: int | None, choose: str
) -> Scene:
    scene = draw_scene(name, downscale=downscale or fitting_divisor([(WIDTH, HEIGHT)], pixels))
    if photographs is None:
        return scene
    poses = np.asarray(scene.train.cameras.camtoworld)
    return keep_photographs(scene, choose_photographs(name, poses, photographs, choose))


def _check_drawn(
    name: str, format: str | None, split: str, invert_masks: bool, alpha_mode: str
) -> None:
    """Refuse options of captures."""
    options = {
        "split": split != "given",
        "format": format is not None,
        "invert_masks": invert_masks,
        "alpha_mode": alpha_mode != "blend",
    }
    if given := [option for option, chosen in options.items() if chosen]:
        raise SceneError(
            f"{name} is a built-in scene with its own split and no masks: leave out {given[0]}."
        )


def _check_options(
    downscale: int | None,
    background: float,
    format: str | None,
    split: str,
    zoom: int | None,
    alpha_mode: str,
) -> None:
    if downscale is not None and (
        isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1
    ):
        raise SceneError(f"downscale must be a whole number of at least 1, got {downscale!r}.")
    if not 0 <= background <= 1:
        raise SceneError(f"background must be a gray level in [0, 1], got {background!r}.")
    if split not in SPLITS:
        raise SceneError(f"split {split!r} is unknown: choose one of {', '.join(SPLITS)}.")
    if format is not None and format not in FORMATS:
        raise SceneError(f"format {format!r} is unknown: choose one of {', '.join(FORMATS)}.")
    if zoom is not None and split != "zoom":
        raise SceneError(f"zoom needs split 'zoom', but split is {split!r}: leave out zoom.")
    if zoom is not None and (isinstance(zoom, bool) or not isinstance(zoom, int) or zoom < 2):
        raise SceneError(f"zoom must be a whole number of at least 2, got {zoom!r}.")
    if alpha_mode not in ALPHA_MODES:
        raise SceneError(
            f"alpha_mode {alpha_mode!r} is unknown: choose one of {', '.join(ALPHA_MODES)}."
        )


def _check_choice(photographs: int | None, choose: str) -> None:
    if photographs is not None and (
        isinstance(photographs, bool) or not isinstance(photographs, int) or photographs < 2
    ):
        raise SceneError(f"photographs must be a whole number of at least 2, got {photographs!r}.")
    if choose not in CHOICES:
        raise SceneError(f"choose {choose!r} is unknown: choose one of {', '.join(CHOICES)}.")
    if choose != "path" and photographs is None:
        raise SceneError(f"choose {choose!r} needs photographs: say how many to keep.")
