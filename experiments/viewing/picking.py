"""A close-up camera for a point that somebody clicked at: arrays only, no window."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.viewing.camera_paths import look
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.poses import closeup_position
from jaxcloseup.geometry.visibility import sample_where_visible
from jaxcloseup.numerics import safe_divide, safe_norm
from jaxcloseup.photographs import Views


def ray_camera(origin: np.ndarray, direction: np.ndarray, focal: float) -> Camera:
    """A camera of 3 x 3 pixels whose middle one looks from `origin [3]` along `direction [3]`.

    Its z-depth is the distance along the ray; `focal`, in pixels, says how wide they are.
    """
    origin, direction = (np.asarray(array, np.float64) for array in (origin, direction))
    pose = look(origin, origin + direction, np.eye(3)[np.argmin(np.abs(direction))])
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
    """How well each photograph shows a point, `[V]`; 0 where it does not.

    The focal length over the depth, so that the finest photograph is the best, times the cosine
    between its ray and the one that was clicked along: a view from the side is worth less, and one
    from behind hardly anything.

    Args:
      views: the training photographs, `V`.
      depths: `[V, H, W]` their z-depth; 0 is undefined.
      point: `[3]` in the world.
      direction: `[3]` of the click, of any length.
      tolerance: relative, within which a photograph's depth must confirm the point's.
    """

    def one(camera, depth, weight):
        _, z, weight = sample_where_visible(camera, depth, weight, point, tolerance)
        ray = point - camera.position
        length = safe_norm(ray) * safe_norm(direction)
        cosine = safe_divide(jnp.sum(ray * direction), length)
        fineness = safe_divide(jnp.sqrt(camera.intrinsics[0] * camera.intrinsics[1]), z)
        return jnp.where(weight > 0, fineness * jnp.maximum(cosine, 1e-3), 0)

    return jax.vmap(one)(views.cameras, depths, views.weight)


def closeup_camera(source: Camera, point: np.ndarray, magnification: float) -> Camera:
    """A training camera that came so many times nearer to a point `[3]` and turned towards it.

    It is at `closeup_position`, has the point at its principal point and the source's upward
    direction, lens and size.
    """
    point = np.asarray(point, np.float64)
    rotation, position = (np.asarray(a, np.float64) for a in (source.rotation, source.position))
    pose = look(closeup_position(point, position, magnification), point, -rotation[:, 1])
    return source.replace(camtoworld=jnp.asarray(pose, jnp.float32))


def seen_camera(rotation: np.ndarray, position: np.ndarray, fov: float, like: Camera) -> Camera:
    """A camera with a pose and a vertical field of view (radians), square pixels, of `like`'s size.

    Args:
      rotation: `[3, 3]` camera to world, OpenCV's frame.
      position: `[3]`.
      fov: between 0 and pi.
      like: whose size it has.
    """
    focal = like.height / 2 / np.tan(fov / 2)
    return Camera(
        jnp.asarray(np.column_stack([rotation, position]), jnp.float32),
        jnp.array([focal, focal, like.width / 2, like.height / 2], jnp.float32),
        like.height,
        like.width,
    )


def vertical_fov(camera: Camera) -> float:
    """Radians between the upper and the lower edge, were the principal point in the middle."""
    return float(2 * np.arctan(camera.height / 2 / np.asarray(camera.intrinsics)[1]))
