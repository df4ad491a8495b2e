"""Places of a scene that are worth a close-up, found in its photographs."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import pixels_to_points, points_to_pixels
from jaxcloseup.photos.views import camera_at


_WIDTH = 480  # pixels, about, of the photographs that are searched, if training read none larger
_STEPS = 12  # windows along each side of a photograph
_APART = 0.3  # of the median depth, between two places
_ENOUGH = 0.6  # mean trust in the depth of a window


class Place(NamedTuple):
    """A pixel of a photograph, in shares of its width and height."""

    view: int
    x: float
    y: float


class _Found(NamedTuple):
    score: float
    place: Place
    point: np.ndarray


def best_places(detail: Detail, *, count: int, near: float) -> list[Place]:
    """Return where many photographs look and show contrast in fine structures.

    Each place is that of a window that a close-up shows whole, and in which depth is trusted. No
    two are near each other.

    Args:
      detail: of a trained state.
      count: largest number of places.
      near: how many times nearer close-ups are.
    """
    found: list[_Found] = []
    depths: list[float] = []
    for view in range(detail.sources.maps.shape[0]):
        here, depth = _windows_of(detail, view, near)
        found += here
        depths.append(depth)
    if not found:
        return []
    share = _looked_at(detail, np.stack([one.point for one in found]))
    found = [one._replace(score=one.score * part) for one, part in zip(found, share, strict=True)]
    apart = _APART * float(np.nanmedian(depths))
    chosen: list[_Found] = []
    for one in sorted(found, key=lambda one: -one.score):
        if len(chosen) == count:
            break
        if all(
            one.place.view != other.place.view and np.linalg.norm(one.point - other.point) > apart
            for other in chosen
        ):
            chosen.append(one)
    return [one.place for one in chosen]


def _looked_at(detail: Detail, points: np.ndarray) -> np.ndarray:
    """Return the share `[N]` of the photographs that have points `[N, 3]` in their middle half."""
    cameras = detail.sources.cameras
    pixels, depth = jax.vmap(points_to_pixels, in_axes=(0, None))(cameras, jnp.asarray(points))
    shares = np.asarray(pixels) / np.asarray(detail.map_sizes)[:, ::-1][:, None]
    inside = np.all(np.abs(shares - 0.5) < 0.25, axis=-1)
    return np.mean(inside & (np.asarray(depth) > 0), axis=0)


def _windows_of(detail: Detail, view: int, near: float) -> tuple[list[_Found], float]:
    """Return the windows of a photograph whose depth is trusted, and its median depth."""
    shown, sources = detail.shown, detail.sources
    colors = np.asarray(shown.image(view, shown.level_near(_WIDTH)), np.float32)[..., 3:6]
    rows, columns = colors.shape[:2]
    width, height = np.asarray(detail.map_sizes)[:, ::-1][view]
    trust, inverse = (
        cv2.resize(np.asarray(maps[view])[:height, :width], (columns, rows), interpolation=how)
        for maps, how in (
            (sources.trust, cv2.INTER_AREA),
            (sources.inverse_depth, cv2.INTER_NEAREST),
        )
    )
    gray = colors.mean(axis=-1)
    fine = np.abs(gray - cv2.GaussianBlur(gray, (0, 0), 2))
    size = max(3, round(columns / near)), max(3, round(rows / near))
    contrast, trusted = (cv2.blur(values, size) for values in (fine * trust, trust))
    # Centers of windows that lie in the photograph.
    x, y = (
        np.linspace(side // 2, whole - 1 - side // 2, _STEPS).astype(int)
        for side, whole in zip(size, (columns, rows), strict=True)
    )
    x, y = (axis.ravel() for axis in np.meshgrid(x, y))
    kept = (trusted[y, x] >= _ENOUGH) & (inverse[y, x] > 0)
    x, y = x[kept], y[kept]
    shares = (np.stack([x, y], axis=-1) + 0.5) / [columns, rows]
    depth = 1 / inverse[y, x]
    camera, pixels = camera_at(sources.cameras, view), shares * [width, height]
    points = np.asarray(pixels_to_points(camera, jnp.asarray(pixels, jnp.float32), depth))
    places = [Place(view, *share) for share in shares.tolist()]
    scores = contrast[y, x].tolist()
    found = [_Found(*each) for each in zip(scores, places, points, strict=True)]
    return found, float(np.median(depth)) if len(depth) else float("nan")
