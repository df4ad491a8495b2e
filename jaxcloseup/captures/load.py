"""`load_scene`: load a built-in scene by name, or a capture from its folder."""

import pathlib

from jaxcloseup.captures import ALPHA_MODES, FORMATS, SPLITS, Reading, load_capture
from jaxcloseup.captures.splits import spread
from jaxcloseup.drawn_scenes import DRAWN_SCENES, draw_scene
from jaxcloseup.photos.scene import Scene, SceneError, SceneWarning, Surface, keep_photographs


__all__ = ["DRAWN_SCENES", "Scene", "SceneError", "SceneWarning", "Surface", "load_scene"]

_DEFAULT_ZOOM = 4


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
    photographs: int | None = None,
) -> Scene:
    """Load a built-in scene by its name, or a capture from its folder.

    The loader reads the first of these that the folder holds:

    - `transforms_train.json`, with optional `transforms_test.json` (split `test`) and
      `transforms_test_far.json` or Blender's `transforms_val.json` (split `test_far`). The `test`
      split is meant for close-ups; the loader does not check that its views are close.
    - `transforms.json` from instant-ngp or nerfstudio. Its `train_filenames`, `test_filenames` and
      `val_filenames` list the splits `train`, `test` and `test_far`.
    - A COLMAP model, binary or text, in `sparse/0`, `sparse` or `colmap/sparse/0`, with the
      photographs in `images`. The path may also name the model's own folder.
    - LLFF's `poses_bounds.npy`, with the photographs in `images`.

    If these files list no splits, `split.json` may list the names in `train`, `test` and
    `test_far`. Without it, every 8th photograph by name becomes `test_far`.

    Distorted photographs are resampled to a pinhole camera of the same size and focal lengths;
    pixels outside the distorted photograph get weight 0. Photographs of different sizes are padded
    at the right and the bottom with weight 0; each camera keeps its own intrinsics. Masks weight
    pixels: white is 1, black is 0. A mask is the frame's `mask_path`, or a file of the same name in
    `masks`, or `a.jpg.png` or `a.mask.png` beside `a.jpg` (see `captures/masks.py`).

    Initial points come from the COLMAP model (only points that at least two training photographs
    see), from `ply_file_path`, or from `points3d.ply`. Otherwise the loader triangulates features
    that neighboring training photographs share. `near` and `far` come from the file, or else are
    estimated; the loader warns unless it estimates them from a COLMAP model's points.

    Everything is stored as float32. Lenses and positions that no scene has beside it are refused,
    and absurdly far points are dropped with a warning (see `captures/scale.py` for the bounds).

    Args:
      name_or_path: one of `DRAWN_SCENES`, or a folder; `./table` always names a folder.
      downscale: positive integer factor by which to shrink photographs, by averaging areas. For 2,
        4 and 8 the loader uses `images_2`, `images_4` and `images_8` beside `images` if they hold
        every photograph. It caches what it shrinks in `$XDG_CACHE_HOME/jaxcloseup/photographs`.
      half_pixel: whether the files put pixel centers at integers, as the paper's data does.
      background: gray level in [0, 1] behind transparent pixels.
      format: the only format to read, `transforms`, `colmap` or `llff`; None reads the first found.
      split: how to hold out photographs.
        `given`: as the files say.
        `every8`: every 8th photograph by name is `test_far`.
        `closest`: the closest tenth of the photographs is `test`, measured by median point depth
        over focal length in pixels; every 8th of the rest is `test_far`.
        `zoom`: every 8th photograph is `test_far`. The others are trained on at `1 / zoom` of their
        size, and every 8th of them yields a crop at full size for `test`, `zoom` times finer from
        the same position. The crop is the one of `zoom` x `zoom` parts with the most detail (sum of
        squared differences of neighboring pixels).
      zoom: integer of at least 2 for split `zoom`; None means 4.
      invert_masks: whether masks mark ignored pixels in white instead of black.
      alpha_mode: `blend` shows the background through transparent pixels; `mask` keeps the file's
        colors and uses alpha as the weight.
      photographs: learn from so many of the training photographs, evenly spread over their order;
        None means all. Points that fewer than two of them see are dropped, where a COLMAP model
        says so; of a built-in scene those that lie in the pictures of fewer than two.

    Returns:
      The scene. For a folder, `metadata` holds
        path, downscale, format, split: what was loaded and how;
        files, sizes: by split, the path and the unpadded (width, height) of each photograph;
        applied_transform, applied_scale: `[3, 4]` or None, and a number, from the capture's
          original world to this one;
        up: `[3]` direction that points up in the world, or None where the files do not say;
        notes: sentences on what was read and how it was split;
        times_nearer: for `closest` and `zoom`, how many times nearer (or finer) each `test` view is
          than the median training photograph;
        corners: for `zoom`, the crop's first pixel (x, y) in its photograph shrunk by `downscale`.

    Raises:
      SceneError: one sentence that names the file and the field and says what to do.
    """
    _check_options(downscale, background, format, split, zoom, alpha_mode, photographs)
    zoom = (zoom or _DEFAULT_ZOOM) if split == "zoom" else 1
    reading = Reading(downscale, zoom, background, half_pixel, alpha_mode, invert_masks)
    path = pathlib.Path(name_or_path)
    if len(path.parts) == 1 and str(name_or_path) == path.name:
        if path.name in DRAWN_SCENES:
            capture_options = {
                "split": split != "given",
                "format": format is not None,
                "invert_masks": invert_masks,
                "alpha_mode": alpha_mode != "blend",
            }
            if given := [name for name, chosen in capture_options.items() if chosen]:
                raise SceneError(
                    f"{path} is a built-in scene with its own split and no masks: leave out "
                    f"{given[0]}."
                )
            scene = draw_scene(path.name, downscale=downscale)
            return keep_photographs(scene, spread(scene.name, len(scene.train), photographs))
        if not path.exists():
            raise SceneError(
                f"{path} is neither a folder nor a built-in scene: choose one of "
                f"{', '.join(DRAWN_SCENES)}, or give the path of a capture."
            )
    return load_capture(path, reading, format=format, split=split, photographs=photographs)


def _check_options(
    downscale: int,
    background: float,
    format: str | None,
    split: str,
    zoom: int | None,
    alpha_mode: str,
    photographs: int | None,
) -> None:
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
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
    if photographs is not None and (
        isinstance(photographs, bool) or not isinstance(photographs, int) or photographs < 2
    ):
        raise SceneError(f"photographs must be a whole number of at least 2, got {photographs!r}.")
