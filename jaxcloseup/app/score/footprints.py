"""Blur true images to the detail of photographs: a label cannot be sharper than its source."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.warp import backward_warp
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import camera_at


_SIGMAS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)


def blur_to_footprint(image: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Blur an image as if it were photographed with pixels `footprint` times as large.

    A photograph averages over its pixel (variance 1/12), and bilinear sampling over the neighbors
    (1/6), so the standard deviation is half a source pixel. The variance that the image's own
    pixels already have is subtracted.

    Args:
      image: `[H, W, 3]` image to blur.
      footprint: `[H, W]` side of a source pixel, in pixels of the image.

    Returns:
      `[H, W, 3]` blurred image.
    """
    sigma = np.sqrt(np.maximum(footprint**2 / 4 - 1 / 12, 0))
    levels = [image] + [cv2.GaussianBlur(image, (0, 0), s) for s in _SIGMAS[1:]]
    position = np.interp(sigma, _SIGMAS, np.arange(len(_SIGMAS)))
    low = np.minimum(position.astype(int), len(_SIGMAS) - 2)
    rows, columns = np.indices(sigma.shape)
    stack, share = np.stack(levels), (position - low)[..., None]
    return (1 - share) * stack[low, rows, columns] + share * stack[low + 1, rows, columns]


def resolved_by_photographs(
    scene: Scene, camera: Camera, exact_depths: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Blur a camera's true image to the detail of the training photographs.

    At each pixel the photograph with the smallest footprint sets the blur. No label from exact
    depth and all photographs can be better than this image.

    Args:
      scene: a scene with `surface`.
      camera: camera of the image.
      exact_depths: `[V, H, W]` exact depths of the training views.

    Returns:
      `[H, W, 3]` the blurred true image, and `[H, W]` whether any photograph sees the surface.
    """
    assert scene.surface is not None
    assert scene.surface is not None
    truth = scene.surface(camera)
    pixels = pixel_grid(camera.height, camera.width)
    finest = np.full(pixels.shape[:2], np.inf)
    for index, depth in enumerate(exact_depths):
        source = camera_at(scene.train.cameras, index)
        visible, footprint = seen_by(camera, pixels, truth.depth, source, depth)
        finest = np.where(visible, np.minimum(finest, footprint), finest)
    seen = np.isfinite(finest)
    return blur_to_footprint(np.asarray(truth.rgb), np.where(seen, finest, 1)), seen


@jax.jit
def seen_by(
    camera: Camera, pixels: jax.Array, depth: jax.Array, source: Camera, source_depth: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return where a source sees the surfaces of a camera, and how large its pixels are there.

    Args:
      camera: the camera.
      pixels: `[H, W, 2]` its pixel centers.
      depth: `[H, W]` its z-depth; 0 is undefined.
      source: camera of the source.
      source_depth: `[h, w]` z-depth of the source.

    Returns:
      `[H, W]` bool, and `[H, W]` the side of the source's pixels, in pixels of `camera`.
    """
    landed, landed_depth = points_to_pixels(source, pixels_to_points(camera, pixels, depth))
    observed = backward_warp(source_depth[..., None], landed, order=0)[..., 0]
    inside = in_bounds(landed, source.height, source.width)
    visible = (depth > 0) & inside & depth_consistent(observed, landed_depth, 0.02)
    magnification = landed_depth / jnp.where(depth > 0, depth, 1)
    return visible, magnification * camera.intrinsics[0] / source.intrinsics[0]
