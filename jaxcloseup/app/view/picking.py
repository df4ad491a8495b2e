"""Find the surface at a pixel, and choose a close-up camera for it."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.view.camera_paths import look_at
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, crop_camera
from jaxcloseup.geometry.numerics import safe_divide, safe_norm
from jaxcloseup.geometry.poses import closeup_position
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.views import Views


_AROUND = 16  # pixels of an image's part that is rendered for the depth of one of them
_MOST_PIXELS = 2_000_000  # of a rendered window; larger windows show it enlarged


def surface_depth(
    render: Callable[[Camera], Rendering],
    camera: Camera,
    pixel: tuple[float, float],
    *,
    far: float = math.inf,
) -> float:
    """Return the z-depth of the surface at a pixel, in world units; 0 where there is none.

    A few pixels around it are rendered, not the whole image.

    Args:
      render: renders a whole image of a field.
      camera: one camera.
      pixel: (x, y) in its image.
      far: largest z-depth of a surface, world units.
    """
    corner = np.floor(np.asarray(pixel)) - _AROUND // 2
    part = crop_camera(camera, jnp.asarray(corner), height=_AROUND, width=_AROUND)
    return float(label_depth(render(part), near=0, far=far)[_AROUND // 2, _AROUND // 2])


def ray_camera(origin: np.ndarray, direction: np.ndarray, focal: float) -> Camera:
    """Return a camera of 3 x 3 pixels whose center pixel looks along a ray.

    At the center pixel, z-depth is the distance along the ray.

    Args:
      origin: `[3]` start of the ray, in the world.
      direction: `[3]` direction of the ray, of any length.
      focal: focal length in pixels.
    """
    origin, direction = (np.asarray(array, np.float64) for array in (origin, direction))
    pose = look_at(origin, origin + direction, np.eye(3)[np.argmin(np.abs(direction))])
    intrinsics = jnp.array([focal, focal, 1.5, 1.5], jnp.float32)
    return Camera(jnp.asarray(pose, jnp.float32), intrinsics, height=3, width=3)


@jax.jit
def rank_views(
    views: Views,
    depths: jax.Array,
    point: jax.Array,
    direction: jax.Array,
    tolerance: jax.Array | float = 0.02,
) -> jax.Array:
    """Score how well each photograph shows a point.

    The score is the focal length over the point's z-depth, which prefers fine photographs, times
    the cosine between the photograph's ray and the clicked ray, which prefers similar directions.
    A photograph from behind keeps a thousandth of its score.

    Args:
      views: the `V` training photographs.
      depths: `[V, H, W]` z-depths of the photographs; 0 is undefined.
      point: `[3]` the point, in the world.
      direction: `[3]` direction of the clicked ray, of any length.
      tolerance: relative tolerance within which a photograph's depth must confirm the point.

    Returns:
      `[V]` scores; 0 where a photograph does not show the point.
    """

    def score(camera: Camera, depth: jax.Array, weight: jax.Array) -> jax.Array:
        _, z, weight = sample_where_visible(camera, depth, weight, point, tolerance)
        ray = point - camera.position
        length = safe_norm(ray) * safe_norm(direction)
        cosine = safe_divide(jnp.sum(ray * direction), length)
        fineness = safe_divide(jnp.sqrt(camera.intrinsics[0] * camera.intrinsics[1]), z)
        return jnp.where(weight > 0, fineness * jnp.maximum(cosine, 1e-3), 0)

    return jax.vmap(score)(views.cameras, depths, views.weight)


def closeup_camera(source: Camera, point: np.ndarray, magnification: float) -> Camera:
    """Move a training camera `magnification` times nearer to a point, and turn it to the point.

    The camera is at `closeup_position` and shows the point at its principal point. It keeps the
    source's up direction, lens and image size.

    Args:
      source: the training camera.
      point: `[3]` the point, in the world.
      magnification: factor by which the distance to the point shrinks.
    """
    point = np.asarray(point, np.float64)
    rotation, position = (np.asarray(a, np.float64) for a in (source.rotation, source.position))
    # In NumPy, so in float64.
    nearer = closeup_position(point, position, magnification)  # type: ignore[arg-type]
    pose = look_at(np.asarray(nearer), point, -rotation[:, 1])
    return source.replace(camtoworld=jnp.asarray(pose, jnp.float32))


def viewer_camera(rotation: np.ndarray, position: np.ndarray, fov: float, like: Camera) -> Camera:
    """Return a camera with square pixels and a given pose, field of view and image size.

    Args:
      rotation: `[3, 3]` camera-to-world rotation, OpenCV frame.
      position: `[3]` position, in the world.
      fov: vertical field of view in radians, between 0 and pi.
      like: a camera with the image size to use.
    """
    focal = like.height / 2 / np.tan(fov / 2)
    return Camera(
        jnp.asarray(np.column_stack([rotation, position]), jnp.float32),
        jnp.array([focal, focal, like.width / 2, like.height / 2], jnp.float32),
        like.height,
        like.width,
    )


def vertical_fov(camera: Camera) -> float:
    """Return the vertical field of view in radians, for a principal point at the image center."""
    return float(2 * np.arctan(camera.height / 2 / np.asarray(camera.intrinsics)[1]))


def window_size(width: int, height: int, before: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height, in pixels, of what a browser's window is rendered with.

    A page that draws slowly asks for fewer pixels of the same window, and each size compiles its
    own programs: the size before stays unless the window has another shape or grows.

    Args:
      width: of the window's canvas, in pixels.
      height: of the canvas.
      before: the size that this function returned before; (0, 0) at first.
    """
    smaller = min(1.0, (_MOST_PIXELS / max(1, width * height)) ** 0.5)
    width, height = (max(1, round(smaller * side)) for side in (width, height))
    alike = abs(width * before[1] - height * before[0]) <= max(before)  # one pixel of rounding
    return before if alike and width <= before[0] else (width, height)
