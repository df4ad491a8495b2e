"""Load a capture: the photographs, cameras, points and depth range of one folder."""

import functools
import itertools
import logging
import pathlib
import warnings
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxcloseup.captures.depth_range import near_far_from_cameras, near_far_from_points
from jaxcloseup.captures.formats import Listing, read_listing
from jaxcloseup.captures.json_fields import affine_transform, number
from jaxcloseup.captures.names import unique_names
from jaxcloseup.captures.photo import Photo, Reading
from jaxcloseup.captures.photo_checks import (
    check_sizes,
    check_weights,
    warn_copies,
    without_transparent,
)
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.captures.photo_masks import understood_masks
from jaxcloseup.captures.photo_reading import read_photos
from jaxcloseup.captures.scale import LENGTH
from jaxcloseup.captures.triangulation import Triangulated, triangulate
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.messages import printable
from jaxcloseup.photos.scene import NearFarWarning, Scene, SceneError
from jaxcloseup.photos.views import Photograph, Views, pad_images


_UP = (0.0, 0.0, 1.0)
_MEASURED_SIDE = 800  # pixels of photographs whose features measure how near they are
_MIN_POINTS = 100  # fewer triangulated points say too little about where the scene is

_log = logging.getLogger(__name__)


def load_capture(
    path: pathlib.Path,
    reading: Reading,
    *,
    format: str | None = None,
    split: str = "given",
    photographs: int | None = None,
    choose: str = "path",
    pixels: int | None = None,
    corrections: Sequence[str] = (),
) -> Scene:
    """Load the capture in a folder, as `jaxcloseup.captures.load.load_scene` describes.

    With `pixels`, the divisor is chosen, and that of `reading` does not count.

    Raises:
      SceneError: one sentence that names the file and the field and says what to do.
    """
    try:
        listing = read_listing(
            path,
            format=format,
            split=split,
            zoom=reading.zoom,
            downscale=reading.downscale if pixels is None else None,
            pixels=pixels or 1,
            photographs=photographs,
            choose=choose,
            find_points=functools.partial(_points_of, reading),
            corrections=corrections,
        )
    except OSError as error:  # from listing folders; reading a file raises SceneError
        raise SceneError(
            f"{error.filename or path!s:.200} cannot be read ({error.strerror}): make it readable, "
            "or correct its name in the file that lists it."
        ) from error
    masks, notes = understood_masks(
        listing.folder.resolve().name,
        itertools.chain(*listing.frames.values()),
        inverted=reading.invert_masks,
    )
    listing = listing._replace(notes=(*listing.notes, *map(printable, notes)))
    warn_copies(listing)
    for note in listing.notes:
        _log.info(note)
    scene = _load(listing, reading._replace(downscale=listing.downscale, masks=masks))
    scene.metadata.update(path=path, split=split, corrections=tuple(corrections))
    return scene


def _load(listing: Listing, reading: Reading) -> Scene:
    transform, scale = _applied(listing)
    listing, parts = without_transparent(listing, read_photos(listing.frames, reading))
    photos = list(itertools.chain(*parts.values()))
    check_weights(listing.folder, listing.frames, photos, reading)
    check_sizes(listing.file.parent, photos)
    intrinsics = np.stack([photo.intrinsics(reading.half_pixel) for photo in photos])
    camtoworld = np.stack([photo.frame.camtoworld for photo in photos])
    sizes = np.array([photo.size for photo in photos])
    if not len(listing.points):
        listing = _with_points(listing, parts["train"], camtoworld, intrinsics)
    near, far = _near_far(listing, camtoworld, intrinsics, sizes)

    ends = np.cumsum([len(members) for members in parts.values()])[:-1]
    rows = dict(zip(parts, np.split(np.arange(len(photos)), ends), strict=True))
    views = {split: _padded(part, intrinsics[rows[split]]) for split, part in parts.items()}
    files = {split: [photo.frame.file for photo in part] for split, part in parts.items()}
    names = {split: unique_names(paths) for split, paths in files.items()}
    metadata = {
        "downscale": reading.downscale,
        "zoom": reading.zoom,
        "files": files,
        "sizes": {split: [photo.size for photo in part] for split, part in parts.items()},
        "applied_transform": transform,
        "applied_scale": scale,
        "up": _UP if _is_oriented(listing) else None,
        "format": listing.format,
        "notes": listing.notes,
        "point_errors": listing.errors,
    }
    if reading.zoom == 1:
        metadata["own_sizes"] = {
            split: [photo.own_size for photo in part] for split, part in parts.items()
        }
        metadata["distortions"] = {
            split: [photo.frame.distortion for photo in part] for split, part in parts.items()
        }
    if all(frame.seen is not None for frame in listing.frames["train"]):
        metadata["seen"] = [frame.seen for frame in listing.frames["train"]]
    if listing.times_nearer is not None:
        metadata["times_nearer"] = listing.times_nearer
    if reading.zoom > 1 and "test" in parts:
        metadata["corners"] = [photo.corner for photo in parts["test"]]
        names["test"] = [f"{name}_zoom{reading.zoom}" for name in names["test"]]
    return Scene(
        name=printable(listing.folder.resolve().name),
        train=views["train"],
        test=views.get("test"),
        test_far=views.get("test_far"),
        points=listing.points,
        rgb=listing.rgb,
        near=near,
        far=far,
        names=names,
        metadata=metadata,
        # With a zoom, finer photographs would show the very crops that are held out.
        photographs_at=None if reading.zoom > 1 else functools.partial(_read_at, listing, reading),
        placement=listing.placement,
    )


def _applied(listing: Listing) -> tuple[np.ndarray | None, float]:
    """Return the transform `[3, 4]`, if any, and the scale that made the world of the files."""
    transform = listing.fields.get("applied_transform")
    if transform is not None:
        transform = affine_transform(str(listing.file), "applied_transform", transform)
        if np.linalg.matrix_rank(transform[:, :3]) < 3:
            raise SceneError(
                f"{listing.file}: applied_transform flattens space and has no inverse: correct it."
            )
    scale = listing.fields.get("applied_scale", 1.0)
    return transform, number(str(listing.file), "applied_scale", scale, above=0)


def _is_oriented(listing: Listing) -> bool:
    """Return True if a capture says that z points up.

    Blender's files give an angle of view. `orientation_override: none` tells nerfstudio to keep the
    orientation, because a phone has measured it.
    """
    fields = listing.fields
    return "camera_angle_x" in fields or fields.get("orientation_override") == "none"


def _read_at(
    listing: Listing, reading: Reading, factor: int, split: str = "train"
) -> list[Photograph]:
    """Read the photographs of a split again, at 1 / `factor` of their own size."""
    frames = [frame._replace(reduced=None) for frame in listing.frames[split]]
    photos = read_photos({split: frames}, reading._replace(downscale=factor))[split]
    return [Photograph(_camera(photo, reading), photo.rgb, photo.mask) for photo in photos]


def _camera(photo: Photo, reading: Reading) -> Camera:
    width, height = photo.size
    return Camera(
        camtoworld=jnp.asarray(photo.frame.camtoworld, jnp.float32),
        intrinsics=jnp.asarray(photo.intrinsics(reading.half_pixel), jnp.float32),
        height=height,
        width=width,
    )


def _padded(photos: Sequence[Photo], intrinsics: np.ndarray) -> Views:
    """Pad the photographs of a split to one size."""
    width, height = np.array([photo.size for photo in photos]).max(0).tolist()
    poses = np.stack([photo.frame.camtoworld for photo in photos])
    return Views(
        cameras=Camera(
            camtoworld=jnp.asarray(poses, jnp.float32),
            intrinsics=jnp.asarray(intrinsics, jnp.float32),
            height=height,
            width=width,
        ),
        rgb=jnp.asarray(pad_images([photo.rgb for photo in photos], height, width)),
        weight=jnp.asarray(pad_images([photo.mask for photo in photos], height, width)) / 255,
    )


def _with_points(
    listing: Listing, photos: Sequence[Photo], camtoworld: np.ndarray, intrinsics: np.ndarray
) -> Listing:
    """Add points triangulated from the training photographs to a listing without points.

    What the capture's files say of points, which photographs see them and how well, goes.

    Args:
      listing: listing without points.
      photos: training photographs.
      camtoworld: `[V, 3, 4]` poses of all photographs, those of `photos` first.
      intrinsics: `[V, 4]` intrinsics, in the same order.
    """
    count = len(photos)  # held-out photographs must not leak into training
    if count < 2:
        return listing
    points, rgb, _ = _triangulate(photos, camtoworld[:count], intrinsics[:count])
    if len(points) < _MIN_POINTS:
        return listing
    note = printable(
        f"{listing.folder.resolve().name} has no points: {len(points)} were triangulated from "
        f"features of its {count} training photographs"
    )
    _log.info(note)
    frames = {
        split: [frame._replace(seen=None) for frame in part]
        for split, part in listing.frames.items()
    }
    return listing._replace(
        frames=frames, points=points, rgb=rgb, errors=None, notes=(*listing.notes, note)
    )


def _triangulate(
    photos: Sequence[Photo], camtoworld: np.ndarray, intrinsics: np.ndarray
) -> Triangulated:
    images, masks = [photo.rgb for photo in photos], [photo.mask for photo in photos]
    return triangulate(images, masks, camtoworld, intrinsics)


def _points_of(reading: Reading, frames: Sequence[Frame]) -> tuple[list[Frame], np.ndarray]:
    """Triangulate points of all photographs, to measure how near each is; see `FindPoints`."""
    size = frames[0].size or read_image(frames[0].file).shape[1::-1]
    downscale = max(1, round(max(size) / _MEASURED_SIDE))
    masks, _ = understood_masks("", frames, inverted=reading.invert_masks)
    reading = reading._replace(downscale=downscale, zoom=1, masks=masks)
    photos = read_photos({"train": frames}, reading)["train"]
    poses = np.stack([frame.camtoworld for frame in frames])
    intrinsics = np.stack([photo.intrinsics(reading.half_pixel) for photo in photos])
    points, _, views = _triangulate(photos, poses, intrinsics)
    seen = [np.flatnonzero((views == i).any(axis=1)) for i in range(len(frames))]
    return [frame._replace(seen=s) for frame, s in zip(frames, seen, strict=True)], points


def _near_far(
    listing: Listing, camtoworld: np.ndarray, intrinsics: np.ndarray, sizes: np.ndarray
) -> tuple[float, float]:
    label, unit = str(listing.file), listing.placement.scale
    given = {
        key: unit * number(label, key, listing.fields[key], above=0)
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
        if source == "poses" or listing.format != "colmap":  # COLMAP has no such field
            warnings.warn(
                f"{label}: no {absent}; estimated near {near / unit:.4g} and far {far / unit:.4g} "
                f"from the {source}: give both in its unit if they do not enclose the scene.",
                NearFarWarning,
                stacklevel=2,
            )
    if near >= far:
        raise SceneError(
            f"{label}: near {near / unit:.4g} is not less than far {far / unit:.4g}: correct them."
        )
    if near < 1 / LENGTH or far > LENGTH:
        raise SceneError(
            f"{label}: near {near / unit:.4g} and far {far / unit:.4g} must lie between "
            f"{1 / LENGTH / unit:.3g} and {LENGTH / unit:.3g}: correct them."
        )
    return near, far
