"""Scenes by name or from a folder of photographs."""

import pathlib

from jaxcloseup.captures.formats import FORMATS
from jaxcloseup.captures.loading import load_capture
from jaxcloseup.captures.photo_reading import ALPHA_MODES, Reading
from jaxcloseup.captures.splits import SPLITS
from jaxcloseup.procedural.loading import PROCEDURAL_SCENES, procedural_scene
from jaxcloseup.scene import Scene, SceneError, SceneWarning, Surface


__all__ = ["PROCEDURAL_SCENES", "Scene", "SceneError", "SceneWarning", "Surface", "load_scene"]

_ZOOM = 4


def load_scene(
    name_or_path: str | pathlib.Path,
    *,
    downscale: int = 1,
    half_pixel: bool = False,
    background: float = 1.0,
    format: str | None = None,
    split: str = "given",
    zoom: int | None = None,
    invert_masks: bool = False,
    alpha_mode: str = "blend",
) -> Scene:
    """A built-in scene by its name, or a capture from its folder.

    A folder holds, in order of precedence,

    - `transforms_train.json`, and beside it `transforms_test.json` (split `test`) and
      `transforms_test_far.json` or, as Blender's datasets name it, `transforms_val.json` (split
      `test_far`). `test` is meant for close-ups, but nothing checks that its views are; or
    - `transforms.json`, of instant-ngp or nerfstudio. Its `train_filenames`, `test_filenames` and
      `val_filenames` are the three splits; or
    - a COLMAP model, binary or text, in `sparse/0`, `sparse` or `colmap/sparse/0`, with the
      photographs in `images`. The model's own folder can be given too; or
    - LLFF's `poses_bounds.npy`, with the photographs in `images`.

    Where these list no splits, a `split.json` may, with lists `train`, `test` and `test_far` of
    names; without it every 8th photograph, sorted by name, is held out as `test_far`.

    Photographs through lenses that bend are resampled to those of a pinhole camera of the same
    size and focal lengths; pixels that they do not show have weight 0. Photographs of several
    sizes are padded at the right and the bottom with pixels of weight 0, and each camera keeps its
    own intrinsics. A mask weighs their pixels: white counts, black does not. It is a frame's
    `mask_path`, or lies in `masks` beside the folder of the photographs under the same name, or
    beside its photograph as `a.jpg.png` or `a.mask.png` (`scenes/masks.py`).

    Initial points are the COLMAP model's, but for those that fewer than two training photographs
    see, or come from `ply_file_path`, else from `points3d.ply`, else are triangulated from features
    that neighboring training photographs share. `near` and `far` are the file's, or are estimated,
    with a warning unless a COLMAP model's points give them.

    Args:
      name_or_path: one of `PROCEDURAL_SCENES`, or a folder; `./table` is the folder of that name.
      downscale: whole number by which photographs shrink, by averaging areas. For 2, 4 and 8 a
        folder `images_2`, ... beside `images` is taken as it is, if all of them are in it. What is
        reduced here is kept in `$XDG_CACHE_HOME/jaxcloseup/photographs`.
      half_pixel: the files count pixel centers at whole numbers, as the paper's do.
      background: gray level in [0, 1] behind transparent pixels.
      format: read `transforms`, `colmap` or `llff` and nothing else; None: the first that is there.
      split: `given`: as the capture says; `every8`: every 8th photograph by name is `test_far`;
        `closest`: the tenth of the photographs that are nearest to what they see, by the median
        depth of its points over the focal length in pixels, is `test`, and of the rest every 8th
        is `test_far`; `zoom`: every 8th photograph is `test_far`, the rest is trained on reduced
        `zoom` times more, and of every 8th of these one part of their own size, not reduced, is
        `test`: exactly `zoom` times as fine, from the same place. It is that of `zoom` x `zoom`
        with most detail: squared differences of neighboring pixels that count.
      zoom: whole number of at least 2, of split `zoom` alone; None: 4.
      invert_masks: white is ignored and black counts.
      alpha_mode: `blend`: transparent pixels show the background; `mask`: they weigh as much as
        they are opaque, and their colors are those in the file.

    Returns:
      The scene. For a folder, `metadata` holds `path`, `downscale`, `files` and `sizes` (the path
      and, before padding, the (width, height) of each photograph, by split) and
      `applied_transform` and `applied_scale` (`[3, 4]` or None and a number, from the capture's
      original world to this one), `format`, `split`, `notes` (sentences on what was read and how it
      was divided) and, for `closest` and `zoom`, `times_nearer` (how many times nearer, or finer,
      each view of `test` is than the median training photograph); for `zoom` `corners` (of each
      view of `test` the first pixel (x, y) in its photograph, reduced by `downscale`).

    Raises:
      SceneError: one sentence that names the file and the field and says what to do.
    """
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise SceneError(f"downscale must be a whole number of at least 1, got {downscale!r}.")
    if not 0 <= background <= 1:
        raise SceneError(f"background must be a gray level in [0, 1], got {background!r}.")
    if split not in SPLITS:
        raise SceneError(f"split {split!r} is unknown: choose one of {', '.join(SPLITS)}.")
    if format is not None and format not in FORMATS:
        raise SceneError(f"format {format!r} is unknown: choose one of {', '.join(FORMATS)}.")
    if zoom is not None and split != "zoom":
        raise SceneError(f"zoom is of split zoom, and split is {split}: leave zoom out.")
    if zoom is not None and (isinstance(zoom, bool) or not isinstance(zoom, int) or zoom < 2):
        raise SceneError(f"zoom must be a whole number of at least 2, got {zoom!r}.")
    zoom = (zoom or _ZOOM) if split == "zoom" else 1
    if alpha_mode not in ALPHA_MODES:
        raise SceneError(
            f"alpha_mode {alpha_mode!r} is unknown: choose one of {', '.join(ALPHA_MODES)}."
        )
    reading = Reading(downscale, zoom, background, half_pixel, alpha_mode, invert_masks)
    path = pathlib.Path(name_or_path)
    if len(path.parts) == 1 and str(name_or_path) == path.name:
        if path.name in PROCEDURAL_SCENES:
            of_captures = {
                "split": split != "given",
                "format": format is not None,
                "invert_masks": invert_masks,
                "alpha_mode": alpha_mode != "blend",
            }
            if given := [name for name, chosen in of_captures.items() if chosen]:
                raise SceneError(
                    f"{path} is a built-in scene with a split of its own and no masks: leave out "
                    f"{given[0]}."
                )
            return procedural_scene(path.name, downscale=downscale)
        if not path.exists():
            raise SceneError(
                f"{path} is neither a folder nor a built-in scene: choose one of "
                f"{', '.join(PROCEDURAL_SCENES)}, or give the path of a capture."
            )
    return load_capture(path, reading, format=format, split=split)
