"""Extract a colored mesh from a trained state by fusing depth maps of its training views."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.progress import track
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.artifacts.mesh_files import Mesh, surface_mesh
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.fusion import fuse, fuse_grid, prepare_depth_maps
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.support import count_seen
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.training.state import TrainState


TRUNCATION = 4  # voxels at which distances are cut
_STEEPEST = 3  # largest difference of neighbors, in voxels; near one surface it is at most 1
_FINER = 4  # largest width of a depth map over that of its photograph
_MOST_PIXELS = 2**26  # of all depth maps, unless the photographs have more
_OUTSIDE = 0.005  # share of points beyond each side of the default region
BYTES_PER_VOXEL = 24  # memory of fusing distances and of marching cubes

_fuse_grid = jax.jit(fuse_grid, static_argnames="shape")
_fuse, _depth_maps, _count_seen = jax.jit(fuse), jax.jit(prepare_depth_maps), jax.jit(count_seen)


class Maps(NamedTuple):
    """Rendered training views."""

    # the rendered colors, uint8, and weights, which are 0 where the surface is unknown
    views: Views
    depths: jax.Array  # `[V, H, W]` z-depth, 0 where undefined


class Grid(NamedTuple):
    """Grid for fused distances."""

    corner: np.ndarray  # `[3]` first point, in the world
    voxel: float  # distance between neighbors, in world units
    shape: tuple[int, int, int]  # number of points along each axis


def rendered_view(programs: Programs, state: TrainState) -> Callable[[Camera], tuple]:
    """Return `camera -> (rgb, depth)` of a state; the depth is the median if its field has one."""
    scene, choose = programs.scene, programs.method.with_expected_depth
    if choose is not None:
        state = state.replace(buffers=choose(state.buffers, False))

    def see(camera: Camera) -> tuple[jax.Array, jax.Array]:
        rendering = programs.render(state, camera)
        return rendering.rgb, label_depth(rendering, near=scene.near, far=scene.far)

    return see


def exact_view(scene: Scene) -> Callable[[Camera], tuple]:
    """Return `camera -> (rgb, depth)` of the exact surface of a built-in scene."""

    def see(camera: Camera) -> tuple[jax.Array, jax.Array]:
        assert scene.surface is not None
        surface = scene.surface(camera)
        return surface.rgb, surface.depth

    return see


def see_training_views(
    scene: Scene, see: Callable[[Camera], tuple], *, finer: int, support: int
) -> Maps:
    """Render all training views, and keep the pixels whose surface enough of them show.

    Args:
      scene: the scene.
      see: `camera -> (rgb, depth)`.
      finer: width of the rendered views over that of the photographs.
      support: number of training views that must show a pixel's surface, its own included.
    """
    cameras, weight = larger_views(scene, finer)
    numbers = range(len(scene.train))
    rgb, depths = [], []
    for index in track(numbers, "rendering training views"):
        colors, depth = see(camera_at(cameras, index))
        rgb.append(to_uint8(colors))
        depths.append(np.asarray(depth))
    maps = Maps(Views(cameras, jnp.asarray(np.stack(rgb)), weight), jnp.asarray(np.stack(depths)))
    pixels, kept = pixel_grid(cameras.height, cameras.width), []
    for index in track(numbers, "finding which views see each surface"):
        camera, depth = camera_at(cameras, index), maps.depths[index]
        count = _count_seen(camera, pixels, depth, *maps)
        kept.append(weight[index] * (count >= support))
    return maps._replace(views=maps.views.replace(weight=jnp.stack(kept)))


def larger_views(scene: Scene, finer: int) -> tuple[Camera, jax.Array]:
    """Return stacked cameras and weights `[V, H, W]` of the training views with finer pixels."""
    cameras = scene.train.cameras
    cameras = cameras.replace(
        intrinsics=cameras.intrinsics * finer,
        height=cameras.height * finer,
        width=cameras.width * finer,
    )
    return cameras, scene.train.weight.repeat(finer, axis=1).repeat(finer, axis=2)


def finer_by(scene: Scene, *, renders_pixels: bool) -> int:
    """Return the width of depth maps over that of photographs; rendering single rays is slow."""
    finer = 1 if renders_pixels else _FINER
    while finer > 1 and scene.train.weight.size * finer**2 > _MOST_PIXELS:
        finer //= 2
    return finer


def seen_points(cameras: Camera, depths: jax.Array, weight: jax.Array) -> np.ndarray:
    """Return world points `[P, 3]` of the pixels of depth maps `[V, H, W]` with a weight."""
    pixels, seen = pixel_grid(cameras.height, cameras.width), []
    for index, depth in enumerate(depths):
        points = pixels_to_points(camera_at(cameras, index), pixels, depth)
        seen.append(np.asarray(points)[np.asarray((weight[index] > 0) & (depth > 0))])
    return np.concatenate(seen)


def exact_points(scene: Scene, finer: int) -> np.ndarray:
    """Return points `[P, 3]` of the exact surface of a built-in scene that training views show."""
    cameras, weight = larger_views(scene, finer)
    surface = scene.surface
    assert surface is not None
    # Depth alone takes a tenth of the time of colors, which need several samples in a pixel.
    see = jax.jit(lambda camera: surface(camera).depth)
    depths = jnp.stack([see(camera_at(cameras, i)) for i in range(len(scene.train))])
    return seen_points(cameras, depths, weight)


def box_around(points: np.ndarray) -> np.ndarray:
    """Return the smallest and largest coordinates `[2, 3]` of points, except a few far ones."""
    return np.quantile(points, [_OUTSIDE, 1 - _OUTSIDE], axis=0)


def make_grid(box: np.ndarray, voxel: float) -> Grid:
    """Return a grid that holds a box `[2, 3]` with a margin of the truncation distance."""
    margin = TRUNCATION * voxel
    low, high = np.asarray(box[0]) - margin, np.asarray(box[1]) + margin
    x, y, z = (int(count) for count in np.ceil((high - low) / voxel) + 1)
    return Grid(low.astype(np.float32), voxel, (x, y, z))


def fuse_mesh(maps: Maps, grid: Grid) -> Mesh:
    """Fuse depth maps into distances on a grid, and return their surface with its colors."""
    fused = _depth_maps(maps.views.cameras, maps.depths, maps.views.weight)
    reach = jnp.float32(TRUNCATION * grid.voxel)
    corner, voxel = jnp.asarray(grid.corner), jnp.float32(grid.voxel)
    distance = _fuse_grid(corner, voxel, grid.shape, fused, reach)
    mesh = surface_mesh(
        np.asarray(distance), grid.corner, grid.voxel, steepest=_STEEPEST / TRUNCATION
    )
    if not len(mesh.faces):
        return mesh
    colors = _fuse(jnp.asarray(mesh.vertices), fused, reach, maps.views.rgb).values
    return mesh._replace(rgb=to_uint8(colors[None])[0])
