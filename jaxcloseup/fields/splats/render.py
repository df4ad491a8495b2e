"""Renders surfels by 2-D, and volumetric Gaussians by 3-D Gaussian splatting."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from jaxcloseup.fields.contract import Rendering
from jaxcloseup.fields.splats import surfels_native
from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.culling import map_shown, may_show
from jaxcloseup.fields.splats.ellipsoids import project_ellipsoids
from jaxcloseup.fields.splats.layout import pack
from jaxcloseup.fields.splats.projection import (
    SurfelColumns,
    offsets,
    project_discs,
    surfel_columns,
    to_camera,
)
from jaxcloseup.fields.splats.raster_plan import plan_raster
from jaxcloseup.fields.splats.rasterize import SplatImage, blend, image_of
from jaxcloseup.fields.splats.spherical_harmonics import sh_to_channels
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.cameras import Camera


class SurfelAux(NamedTuple):
    """Images of surfels besides color, expected depth and alpha.

    Attributes:
      normal: `[H, W, 3]` sum of w_i n_i, world frame, facing the camera, not normalized; None of
        volumetric Gaussians.
      median_depth: `[H, W]` z-depth at which the transmittance falls to 1/2, else that of the last
        drawn surfel; 0 where no surfel is drawn.
      distortion: `[H, W]` sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2.
      overflow: `[]` int32 number of (tile, surfel) pairs that did not fit; the image is wrong where
        it is not 0.
    """

    normal: jax.Array | None
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
    """Render a whole image by 2-D (Huang et al. 2024) or 3-D splatting (Kerbl et al. 2023).

    Differentiable in the surfels, the background and the camera's pose and intrinsics; batch over
    cameras with `jax.vmap`. Depth is the depth at which rays meet the discs, not that of their
    centers; of volumetric Gaussians, which rays do not meet at any one depth, it is the centers'.

    The image is right only where `overflow` is 0. It is an array, so check it outside `jax.jit`;
    where it is not 0, double `config.capacity` and render again.

    Args:
      surfels: `N` surfels, or volumetric Gaussians, which have three scales.
      alive: `[N]` bool; dead surfels are not drawn.
      camera: one camera.
      config: static sizes of the rasterizer.
      background: `[3]` color behind everything; None is black.

    Returns:
      A `Rendering` of `[H, W]` pixels with `normal` and `overflow`, whose `aux` is a `SurfelAux`.
    """
    count = alive.shape[0]
    chex.assert_shape(surfels.means, (count, 3))
    chex.assert_shape(surfels.log_scales, (count, {2, 3}))
    chex.assert_shape(surfels.quaternions, (count, 4))
    chex.assert_shape(surfels.opacity_logits, (count,))
    chex.assert_shape(surfels.sh, (count, None, 3))
    chex.assert_shape(camera.camtoworld, (3, 4))
    chex.assert_shape(camera.intrinsics, (4,))

    opacity = jnp.where(alive, jax.nn.sigmoid(surfels.opacity_logits), 0)
    image = _blend(surfels, opacity, camera, config)
    rgb = image.payload[..., :3]
    normal = image.payload[..., 3:] if image.payload.shape[-1] > 3 else None
    if background is not None:
        chex.assert_shape(background, (3,))
        rgb = rgb + (1 - image.alpha)[..., None] * background[None, None]
    aux = SurfelAux(normal, image.median_depth, image.distortion, image.overflow)
    return Rendering(rgb, image.depth, image.alpha, aux, normal=aux.normal, overflow=aux.overflow)


def _blend(
    surfels: Surfels, opacity: jax.Array, camera: Camera, config: RasterizeConfig
) -> SplatImage:
    """Project surfels and blend their colors and normals."""
    plan = plan_raster(config, height=camera.height, width=camera.width)
    if not opacity.size:  # nothing can be gathered from no rows: one that is not drawn
        surfels = jax.tree.map(lambda leaf: jnp.ones((1, *leaf.shape[1:]), leaf.dtype), surfels)
        opacity = jnp.zeros(1, opacity.dtype)
    if plan.compositor == "native" and surfels_native.can_render(surfels, opacity, camera):
        sums, median = surfels_native.render_sums(surfels, opacity, camera, config)
        return image_of(sums, median, jnp.zeros((), jnp.int32))
    # Only surfels that may show are projected, and only pairs that draw are listed.
    shown = may_show(surfels, opacity, camera, near=config.near, antialias=config.antialias)
    project = functools.partial(_project, near=config.near, antialias=config.antialias)
    table, box, order = map_shown(project, (surfel_columns(surfels), opacity), camera, shown)
    return blend(table, box, order, config, height=camera.height, width=camera.width)


def _project(
    items: tuple[SurfelColumns, jax.Array], camera: Camera, *, near: float, antialias: bool
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the table, boxes and order of surfels and their opacities, for `blend`."""
    surfels, opacity = items
    discs, normals = to_camera(surfels, camera)
    x, y, z = offsets(surfels, camera)
    # At the camera's center any direction serves; the gradient must be finite.
    squared = x * x + y * y + z * z
    distance = jnp.sqrt(jnp.where(squared == 0, 1, squared))
    colors = sh_to_channels(surfels.sh, x / distance, y / distance, z / distance)
    volumetric = len(discs.scales) == 3
    project = project_ellipsoids if volumetric else project_discs
    payload = jnp.stack(colors if volumetric else [*colors, *normals])
    footprints = project(discs, opacity, payload, camera, near=near, antialias=antialias)
    return pack(footprints), footprints.box.T, footprints.order
