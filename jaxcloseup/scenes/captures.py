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
from jaxcloseup.scenes.errors import ImageSizeWarning, NearFarWarning, SceneError
from jaxcloseup.scenes.fields import affine_transform, number
from jaxcloseup.scenes.formats import FORMATS, Listing, read_listing
from jaxcloseup.scenes.frames import Frame
from jaxcloseup.scenes.images import pad_images
from jaxcloseup.scenes.photographs import Photo, read_photos, resized_intrinsics
from jaxcloseup.scenes.scene import Scene
from jaxcloseup.scenes.splits import SPLITS, unique_names
from jaxcloseup.scenes.triangulation import triangulate


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
    `mask_path`, or lies in `masks` beside the folder of the photographs under the same name
    (`scenes/masks.py`). Initial points are the COLMAP model's, but for those that fewer than two
    training photographs see, or come from `ply_file_path`, else from `points3d.ply`, else are
    triangulated from features that neighbouring training photographs share. `near` and `far` are
    the file's, or are estimated, with a warning unless a COLMAP model's points give them.

    Args:
      name_or_path: one of `PROCEDURAL_SCENES`, or a folder; `./table` is the folder of that name.
      downscale: whole number by which photographs shrink, by averaging areas.
      half_pixel: the files count pixel centres at whole numbers, as the paper's do.
      background: grey level in [0, 1] behind transparent pixels.
      format: read `transforms`, `colmap` or `llff` and nothing else; None: the first that is there.
      split: `given`: as the capture says; `every8`: every 8th photograph by name is `test_far`;
        `closest`: the tenth of the photographs that are nearest to what they see, by the median
        depth of its points over the focal length in pixels, is `test`, and of the rest every 8th
        is `test_far`.

    Returns:
      The scene. For a folder, `metadata` holds `path`, `downscale`, `files` and `sizes` (the path
      and, before padding, the (width, height) of each photograph, by split) and
      `applied_transform` (`[3, 4]`, from the capture's original world to this one, or None),
      `format`, `split`, `notes` (sentences on what was read and how it was divided) and, for
      `closest`, `times_nearer` (how many times nearer each view of `test` is than the median
      training photograph).

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
    path = pathlib.Path(name_or_path)
    if len(path.parts) == 1 and str(name_or_path) == path.name:
        from jaxcloseup.scenes.procedural import PROCEDURAL_SCENES, procedural_scene

        if path.name in PROCEDURAL_SCENES:
            if split != "given" or format is not None:
                raise SceneError(
                    f"{path} is a built-in scene with a split of its own: leave out "
                    f"{'split' if split != 'given' else 'format'}."
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
        listing = read_listing(path, format=format, split=split)
    except OSError as error:  # of folders; what reads a file says more
        raise SceneError(
            f"{error.filename or path!s:.200} cannot be read ({error.strerror}): permit reading "
            "it, or correct its name where a file lists it."
        ) from error
    for note in listing.notes:
        _log.info(note)
    scene = _load(listing, downscale, half_pixel, background)
    scene.metadata.update(path=path, split=split)
    return scene


def _load(listing: Listing, downscale: int, half_pixel: bool, background: float) -> Scene:
    transform = listing.fields.get("applied_transform")
    if transform is not None:
        transform = affine_transform(str(listing.file), "applied_transform", transform)
        if np.linalg.matrix_rank(transform[:, :3]) < 3:
            raise SceneError(
                f"{listing.file}: applied_transform flattens space, so that nothing leads back: "
                "correct it."
            )

    frames = [frame for members in listing.frames.values() for frame in members]
    photos = read_photos(frames, downscale=downscale, background=background, half_pixel=half_pixel)
    _check_masks(listing, photos)
    _warn_sizes(listing, frames, photos)
    intrinsics = np.stack(
        [
            resized_intrinsics(frame, photo.stored_size, photo.size, half_pixel)
            for frame, photo in zip(frames, photos, strict=True)
        ]
    )
    camtoworld = np.stack([frame.camtoworld for frame in frames])
    sizes = np.array([photo.size for photo in photos])
    if not len(listing.points):
        listing = _with_points(listing, photos, camtoworld, intrinsics)
    near, far = _near_far(listing, camtoworld, intrinsics, sizes)

    width, height = sizes.max(0).tolist()
    ends = np.cumsum([len(members) for members in listing.frames.values()])[:-1]
    parts = dict(zip(listing.frames, np.split(np.arange(len(frames)), ends), strict=True))
    views = {
        split: Views(
            cameras=Camera(
                camtoworld=jnp.asarray(camtoworld[part], jnp.float32),
                intrinsics=jnp.asarray(intrinsics[part], jnp.float32),
                height=height,
                width=width,
            ),
            rgb=jnp.asarray(pad_images([photos[i].rgb for i in part], height, width)),
            weight=jnp.asarray(pad_images([photos[i].mask for i in part], height, width)) / 255,
        )
        for split, part in parts.items()
    }
    files = {split: [frame.file for frame in part] for split, part in listing.frames.items()}
    return Scene(
        name=listing.folder.resolve().name,
        train=views["train"],
        test=views.get("test"),
        test_far=views.get("test_far"),
        points=listing.points,
        rgb=listing.rgb,
        near=near,
        far=far,
        names={split: unique_names(paths) for split, paths in files.items()},
        metadata={
            "downscale": downscale,
            "files": files,
            "sizes": {split: [photos[i].size for i in part] for split, part in parts.items()},
            "applied_transform": transform,
            "format": listing.format,
            "notes": listing.notes,
            **({} if listing.times_nearer is None else {"times_nearer": listing.times_nearer}),
        },
    )


def _with_points(
    listing: Listing, photos: Sequence[Photo], camtoworld: np.ndarray, intrinsics: np.ndarray
) -> Listing:
    """A listing without points, with those that its training photographs agree on."""
    count = len(listing.frames["train"])  # held-out photographs tell nothing of what they show
    if count < 2:
        return listing
    points, rgb = triangulate(
        [photo.rgb for photo in photos[:count]],
        [photo.mask for photo in photos[:count]],
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


def _check_masks(listing: Listing, photos: Sequence[Photo]) -> None:
    """Complain of masks that leave nothing to train on; `train` comes first in `photos`."""
    count = len(listing.frames["train"])
    if not any(photo.mask.any() for photo in photos[:count]):
        raise SceneError(
            f"{listing.folder}: the masks leave no pixel of the {count} training photographs: "
            "white is what counts, so invert them if it is black in these."
        )


def _warn_sizes(listing: Listing, frames: Sequence[Frame], photos: Sequence[Photo]) -> None:
    """Accept images that were resized as a whole, and refuse other sizes than the file's."""
    resized = []
    for frame, photo in zip(frames, photos, strict=True):
        (width, height), (w, h) = photo.stored_size, frame.size or photo.stored_size
        if (width, height) == (w, h):
            continue
        # Resizing rounds each side to whole pixels: its aspect agrees to within one of them.
        if abs(width * h / w - height) > 1 and abs(height * w / h - width) > 1:
            swapped = (w, h) == (height, width)
            turned = ", turned as by an EXIF orientation" if swapped else ""
            raise SceneError(
                f"{frame.label}: the image is {width} x {height} pixels, but w and h are {w} x {h}"
                f"{turned}: restore the image that the camera was solved for, or correct w and h."
            )
        resized.append(f"{frame.listed} is {width} x {height} and not {w} x {h}")
    if resized:
        more = f" and {len(resized) - 1} more" if len(resized) > 1 else ""
        warnings.warn(
            f"{listing.file.parent}: {resized[0]}{more}; intrinsics were scaled to the images.",
            ImageSizeWarning,
            stacklevel=2,
        )


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
