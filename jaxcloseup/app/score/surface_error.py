"""Errors of rendered surfaces against the exact surface, or against a capture's points."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats.regularizers import depth_to_normal
from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.geometry.masks import in_bounds
from jaxcloseup.photos.scene import Surface


class Landmarks(NamedTuple):
    """Points of a capture that are visible in a view."""

    row: np.ndarray  # `[P]` pixel row of each point
    column: np.ndarray  # `[P]` pixel column of each point
    depth: np.ndarray  # `[P]` z-depth of each point


_CELLS = 24  # cells across the image; the nearest point in a cell hides the points behind it
_THICKNESS = 0.05  # relative depth up to which the nearest point does not hide others


def find_landmarks(camera: Camera, points: np.ndarray) -> Landmarks:
    """Return the points in the image that no nearer point in the same cell of the image hides.

    Args:
      camera: camera of the view.
      points: `[N, 3]` points of the capture, in the world.
    """
    pixels, depth = points_to_pixels(camera, jnp.asarray(points))
    shown = np.asarray(in_bounds(pixels, camera.height, camera.width) & (depth > 0))
    pixels, depth = np.asarray(pixels)[shown], np.asarray(depth)[shown]
    column, row = np.floor(pixels).astype(int).T
    side = max(camera.width / _CELLS, 1)
    cell = (row / side).astype(int) * (_CELLS + 1) + (column / side).astype(int)
    nearest = np.full(cell.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    visible = depth <= (1 + _THICKNESS) * nearest[cell]
    return Landmarks(row[visible], column[visible], depth[visible])


def point_depth_error(depth: np.ndarray, landmarks: Landmarks) -> dict[str, float]:
    """Return median and 90th percentile of the relative depth error at the landmarks.

    Args:
      depth: `[H, W]` rendered z-depth.
      landmarks: visible points; without any, both metrics are NaN.
    """
    rendered = np.asarray(depth)[landmarks.row, landmarks.column]
    return _summarize("point_depth_error", np.abs(rendered - landmarks.depth) / landmarks.depth)


def surface_error(camera: Camera, rendering: Rendering, surface: Surface) -> dict[str, float]:
    """Return median and 90th percentile of relative depth errors and of normal errors in degrees.

    Fields that render no normals are scored on the normals of their rendered depth. Pixels without
    an exact surface do not count.

    Args:
      camera: camera of the view.
      rendering: what the field renders, `[H, W]`.
      surface: the exact surface, `[H, W]`.
    """
    depth_error, normal_error = map(np.asarray, _errors(camera, rendering, surface))
    # XLA sorts ten times slower on a CPU.
    depth, normal = (error[~np.isnan(error)] for error in (depth_error, normal_error))
    return _summarize("depth_error", depth) | _summarize("normal_error", normal)


def _summarize(name: str, error: np.ndarray) -> dict[str, float]:
    middle, most = np.percentile(error, [50, 90]) if error.size else (np.nan, np.nan)
    return {f"{name}_median": float(middle), f"{name}_p90": float(most)}


@jax.jit
def _errors(camera: Camera, rendering: Rendering, surface: Surface) -> tuple[jax.Array, jax.Array]:
    """Return relative errors of depth and errors of normals in degrees; NaN is undefined."""
    normal = rendering.normal
    if normal is None:
        normal = depth_to_normal(camera, rendering.depth)
    length = jnp.linalg.norm(normal, axis=-1)
    cosine = jnp.sum(normal * surface.normal, axis=-1) / jnp.where(length > 0, length, 1)
    hit = surface.depth > 0
    angle = jnp.where(hit & (length > 0), jnp.rad2deg(jnp.arccos(jnp.clip(cosine, -1, 1))), jnp.nan)
    error = jnp.abs(rendering.depth - surface.depth) / jnp.where(hit, surface.depth, 1)
    return jnp.where(hit, error, jnp.nan), angle
