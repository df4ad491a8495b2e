"""Surfels to images."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.numerics import safe_norm
from jaxcloseup.splats.projection import project_discs, to_camera
from jaxcloseup.splats.rasterize import RasterizeConfig, rasterize
from jaxcloseup.splats.spherical_harmonics import sh_to_rgb
from jaxcloseup.splats.surfels import Surfels


class SurfelAux(NamedTuple):
    """What surfels render besides color, expected depth and alpha.

    Attributes:
      normal: `[H, W, 3]` sum of w_i n_i in the world's frame, towards the camera, not normalized.
      median_depth: `[H, W]` z-depth at which half of the light is lost; 0 where nothing is hit.
      distortion: `[H, W]` sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2.
      overflow: `[]` (tile, surfel) pairs that did not fit: if not 0 the image is wrong; render it
        again with a larger `RasterizeConfig.capacity`.
    """

    normal: jax.Array
    median_depth: jax.Array
    distortion: jax.Array
    overflow: jax.Array


def render_surfels(
    surfels: Surfels,
    alive: jax.Array,
    camera: Camera,
    config: RasterizeConfig,
    *,
    background: jax.Array | None = None,
) -> Rendering:
    """Render a whole image by 2-D Gaussian splatting (Huang et al. 2024).

    Differentiable in the surfels, the background and the camera's pose and intrinsics; batch over
    cameras with `jax.vmap`. Depth is where rays meet the discs, not the depth of their centers.

    Args:
      surfels: `N` surfels.
      alive: `[N]` bool, False is not drawn.
      camera: one camera.
      config: static sizes.
      background: `[3]` color behind everything, black if None.

    Returns:
      A `Rendering` of `[H, W]` pixels whose `aux` is a `SurfelAux`.
    """
    count = alive.shape[0]
    chex.assert_shape(surfels.means, (count, 3))
    chex.assert_shape(surfels.log_scales, (count, 2))
    chex.assert_shape(surfels.quaternions, (count, 4))
    chex.assert_shape(surfels.opacity_logits, (count,))
    chex.assert_shape(surfels.sh, (count, None, 3))
    chex.assert_shape(camera.camtoworld, (3, 4))
    chex.assert_shape(camera.intrinsics, (4,))

    discs, normals = to_camera(surfels, camera)
    offset = surfels.means - camera.position[None]
    distance = safe_norm(offset, keepdims=True)
    colors = sh_to_rgb(surfels.sh, offset / jnp.where(distance == 0, 1, distance))
    opacity = jnp.where(alive, jax.nn.sigmoid(surfels.opacity_logits), 0)
    payload = jnp.concatenate([colors, normals], axis=-1)
    footprints = project_discs(discs, opacity, payload, camera, near=config.near)
    image = rasterize(footprints, config, height=camera.height, width=camera.width)
    rgb, normal = image.payload[..., :3], image.payload[..., 3:]
    if background is not None:
        chex.assert_shape(background, (3,))
        rgb = rgb + (1 - image.alpha)[..., None] * background[None, None]
    aux = SurfelAux(normal, image.median_depth, image.distortion, image.overflow)
    return Rendering(rgb, image.depth, image.alpha, aux, normal=aux.normal, overflow=aux.overflow)
