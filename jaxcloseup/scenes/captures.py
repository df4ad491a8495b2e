"""Scenes by name or from a folder of photographs."""

import logging
import pathlib
import warnings
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxcloseup.batch import Views
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.scenes.bounds import near_far_from_cameras, near_far_from_points
from jaxcloseup.scenes.checks import check_weights, warn_sizes
from jaxcloseup.scenes.errors import NearFarWarning, SceneError
from jaxcloseup.scenes.fields import affine_transform, number
from jaxcloseup.scenes.formats import FORMATS, Listing, read_listing
from jaxcloseup.scenes.images import pad_images
from jaxcloseup.scenes.photographs import ALPHA_MODES, Photo, Reading, read_photos
from jaxcloseup.scenes.scene import Scene
from jaxcloseup.scenes.splits import SPLITS, unique_names
from jaxcloseup.scenes.triangulation import triangulate


_ZOOM = 4
_LEAST_POINTS = 100  # triangulated; fewer tell too little of where a scene is

_log = logging.getLogger(__name__)


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
    that neighbouring training photographs share. `near` and `far` are the file's, or are estimated,
    with a warning unless a COLMAP model's points give them.

    Args:
      name_or_path: one of `PROCEDURAL_SCENES`, or a folder; `./table` is the folder of that name.
      downscale: whole number by which photographs shrink, by averaging areas. For 2, 4 and 8 a
        folder `images_2`, ... beside `images` is taken as it is, if all of them are in it. What is
        reduced here is kept in `$XDG_CACHE_HOME/jaxcloseup/photographs`.
      half_pixel: the files count pixel centres at whole numbers, as the paper's do.
      background: grey level in [0, 1] behind transparent pixels.
      format: read `transforms`, `colmap` or `llff` and nothing else; None: the first that is there.
      split: `given`: as the capture says; `every8`: every 8th photograph by name is `test_far`;
        `closest`: the tenth of the photographs that are nearest to what they see, by the median
        depth of its points over the focal length in pixels, is `test`, and of the rest every 8th
        is `test_far`; `zoom`: every 8th photograph is `test_far`, the rest is trained on reduced
        `zoom` times more, and of every 8th of these one part of their own size, not reduced, is
        `test`: exactly `zoom` times as fine, from the same place. It is that of `zoom` x `zoom`
        with most detail: squared differences of neighbouring pixels that count.
      zoom: whole number of at least 2, of split `zoom` alone; None: 4.
      invert_masks: white is ignored and black counts.
      alpha_mode: `blend`: transparent pixels show the background; `mask`: they weigh as much as
        they are opaque, and their colours are those in the file.

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
        raise SceneError(f"background must be a grey level in [0, 1], got {background!r}.")
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
        from jaxcloseup.scenes.procedural import PROCEDURAL_SCENES, procedural_scene

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
    try:
        if not path.is_dir():
            raise SceneError(f"{path} is not a folder: give the one that holds the capture.")
        listing = read_listing(path, format=format, split=split, zoom=zoom, downscale=downscale)
    except OSError as error:  # of folders; what reads a file says more
        raise SceneError(
            f"{error.filename or path!s:.200} cannot be read ({error.strerror}): permit reading "
            "it, or correct its name where a file lists it."
        ) from error
    for note in listing.notes:
        _log.info(note)
    scene = _load(listing, reading)
    scene.metadata.update(path=path, split=split)
    return scene


def _load(listing: Listing, reading: Reading) -> Scene:
    transform = listing.fields.get("applied_transform")
    if transform is not None:
        transform = affine_transform(str(listing.file), "applied_transform", transform)
        if np.linalg.matrix_rank(transform[:, :3]) < 3:
            raise SceneError(
                f"{listing.file}: applied_transform flattens space, so that nothing leads back: "
                "correct it."
            )
    scale = listing.fields.get("applied_scale", 1.0)
    scale = number(str(listing.file), "applied_scale", scale, above=0)

    parts = read_photos(listing.frames, reading)
    photos = [photo for members in parts.values() for photo in members]
    check_weights(listing.folder, listing.frames, photos, reading)
    warn_sizes(listing.file.parent, photos)
    intrinsics = np.stack([photo.intrinsics(reading.half_pixel) for photo in photos])
    camtoworld = np.stack([photo.frame.camtoworld for photo in photos])
    sizes = np.array([photo.size for photo in photos])
    if not len(listing.points):
        listing = _with_points(listing, parts["train"], camtoworld, intrinsics)
    near, far = _near_far(listing, camtoworld, intrinsics, sizes)

    width, height = sizes.max(0).tolist()
    ends = np.cumsum([len(members) for members in parts.values()])[:-1]
    rows = dict(zip(parts, np.split(np.arange(len(photos)), ends), strict=True))
    views = {
        split: Views(
            cameras=Camera(
                camtoworld=jnp.asarray(camtoworld[rows[split]], jnp.float32),
                intrinsics=jnp.asarray(intrinsics[rows[split]], jnp.float32),
                height=height,
                width=width,
            ),
            rgb=jnp.asarray(pad_images([photo.rgb for photo in part], height, width)),
            weight=jnp.asarray(pad_images([photo.mask for photo in part], height, width)) / 255,
        )
        for split, part in parts.items()
    }
    files = {split: [photo.frame.file for photo in part] for split, part in parts.items()}
    names = {split: unique_names(paths) for split, paths in files.items()}
    metadata = {
        "downscale": reading.downscale,
        "files": files,
        "sizes": {split: [photo.size for photo in part] for split, part in parts.items()},
        "applied_transform": transform,
        "applied_scale": scale,
        "format": listing.format,
        "notes": listing.notes,
    }
    if listing.times_nearer is not None:
        metadata["times_nearer"] = listing.times_nearer
    if reading.zoom > 1:
        metadata["corners"] = [photo.corner for photo in parts["test"]]
        names["test"] = [f"{name}_zoom{reading.zoom}" for name in names["test"]]
    return Scene(
        name=listing.folder.resolve().name,
        train=views["train"],
        test=views.get("test"),
        test_far=views.get("test_far"),
        points=listing.points,
        rgb=listing.rgb,
        near=near,
        far=far,
        names=names,
        metadata=metadata,
    )


def _with_points(
    listing: Listing, photos: Sequence[Photo], camtoworld: np.ndarray, intrinsics: np.ndarray
) -> Listing:
    """A listing without points, with those that its training photographs agree on.

    `photos` are these, and the first of the poses and intrinsics are theirs.
    """
    count = len(photos)  # held-out photographs tell nothing of what they show
    if count < 2:
        return listing
    points, rgb = triangulate(
        [photo.rgb for photo in photos],
        [photo.mask for photo in photos],
        camtoworld[:count],
        intrinsics[:count],
    )
    if len(points) < _LEAST_POINTS:
        return listing
    note = (
        f"{listing.folder.resolve().name} comes without points: {len(points)} were triangulated "
        f"from features of its {count} training photographs"
    )
    _log.info(note)
    return listing._replace(points=points, rgb=rgb, notes=(*listing.notes, note))


def _near_far(
    listing: Listing,
    camtoworld: np.ndarray,
    intrinsics: np.ndarray,
    sizes: np.ndarray,
) -> tuple[float, float]:
    label = str(listing.file)
    given = {
        key: number(label, key, listing.fields[key], above=0)
        for key in ("near", "far")
        if listing.fields.get(key) is not None
    }
    near, far = given.get("near"), given.get("far")
    if near is None or far is None:
        estimate = near_far_from_points(listing.points, camtoworld, intrinsics, sizes)
        source = "points" if estimate else "poses"
        low, high = estimate or near_far_from_cameras(camtoworld)
        near, far = near or low, far or high
        absent = " and ".join(key for key in ("near", "far") if key not in given)
        if source == "poses" or listing.format != "colmap":  # no field of COLMAP's could be given
            warnings.warn(
                f"{label}: no {absent}; from the {source}, near {near:.4g} and far {far:.4g} are "
                "used: give both in world units if they do not hold the scene.",
                NearFarWarning,
                stacklevel=2,
            )
    if near >= far:
        raise SceneError(f"{label}: near {near:.4g} is not less than far {far:.4g}: correct them.")
    return near, far
