"""The surface of a trained state: depth maps of its training views, fused, as a colored mesh."""

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
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.support import count_seen
from jaxcloseup.photos.tsdf import depth_maps, fuse, fuse_grid
from jaxcloseup.photos.views import Views, camera_at
from jaxcloseup.training.steps import TrainState


TRUNCATION = 4  # voxels at which distances are cut
_STEEPEST = 3  # voxels by which neighbors may differ; the distance to one surface changes by one
_FINER = 4  # times as wide as training photographs are depth maps, at most
_MOST_PIXELS = 2**26  # of all depth maps, unless the photographs themselves have more
_OUTSIDE = 0.005  # share of the points that may lie beyond each side of the default region
BYTES_PER_VOXEL = 24  # while distances are fused, rearranged and marched through

_fuse_grid = jax.jit(fuse_grid, static_argnames="shape")
_fuse, _depth_maps, _count_seen = jax.jit(fuse), jax.jit(depth_maps), jax.jit(count_seen)


class Maps(NamedTuple):
    """What training views see.

    Attributes:
      views: with the colors that they see, uint8, and weights, which are 0 where nothing is known.
      depths: `[V, H, W]` z-depth, 0 where undefined.
    """

    views: Views
    depths: jax.Array


class Grid(NamedTuple):
    """Where distances are fused.

    Attributes:
      corner: `[3]` its first point in the world.
      voxel: distance between neighbors in world units.
      shape: number of points along each axis.
    """

    corner: np.ndarray
    voxel: float
    shape: tuple[int, int, int]


def rendered_view(programs: Programs, state: TrainState) -> Callable[[Camera], tuple]:
    """`camera -> (rgb, depth)` of a state; the median depth where its field has one."""
    scene, choose = programs.scene, programs.method.with_expected_depth
    if choose is not None:
        state = state.replace(buffers=choose(state.buffers, False))

    def see(camera):
        rendering = programs.render(state, camera)
        return rendering.rgb, label_depth(rendering, near=scene.near, far=scene.far)

    return see


def exact_view(scene: Scene) -> Callable[[Camera], tuple]:
    """`camera -> (rgb, depth)` of the exact surface of a built-in scene."""

    def see(camera):
        surface = scene.surface(camera)
        return surface.rgb, surface.depth

    return see


def see_training_views(
    scene: Scene, see: Callable[[Camera], tuple], *, finer: int, support: int
) -> Maps:
    """See all training views, and keep the pixels whose surface enough of them see.

    Args:
      scene: the scene.
      see: `camera -> (rgb, depth)`.
      finer: how many times as wide as the training photographs.
      support: the number of training views that must see a pixel's surface, itself included.
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
    """Stacked cameras and weights `[V, H, W]` of the training views with finer pixels."""
    cameras = scene.train.cameras
    cameras = cameras.replace(
        intrinsics=cameras.intrinsics * finer,
        height=cameras.height * finer,
        width=cameras.width * finer,
    )
    return cameras, scene.train.weight.repeat(finer, axis=1).repeat(finer, axis=2)


def finer_by(scene: Scene, *, renders_pixels: bool) -> int:
    """How many times as wide as training photographs depth maps may be: single rays are slow."""
    finer = 1 if renders_pixels else _FINER
    while finer > 1 and scene.train.weight.size * finer**2 > _MOST_PIXELS:
        finer //= 2
    return finer


def seen_points(cameras: Camera, depths: jax.Array, weight: jax.Array) -> np.ndarray:
    """World points `[P, 3]` of the pixels of depth maps `[V, H, W]` that weigh something."""
    pixels, found = pixel_grid(cameras.height, cameras.width), []
    for index, depth in enumerate(depths):
        points = pixels_to_points(camera_at(cameras, index), pixels, depth)
        found.append(np.asarray(points)[np.asarray((weight[index] > 0) & (depth > 0))])
    return np.concatenate(found)


def exact_points(scene: Scene, finer: int) -> np.ndarray:
    """Points `[P, 3]` of the exact surface of a built-in scene that training views see."""
    cameras, weight = larger_views(scene, finer)
    # Without colors, of which a pixel has several, it takes a tenth of the time.
    see = jax.jit(lambda camera: scene.surface(camera).depth)
    depths = jnp.stack([see(camera_at(cameras, i)) for i in range(len(scene.train))])
    return seen_points(cameras, depths, weight)


def box_around(points: np.ndarray) -> np.ndarray:
    """The smallest and largest coordinates `[2, 3]` of points, but for a few far ones."""
    return np.quantile(points, [_OUTSIDE, 1 - _OUTSIDE], axis=0)


def make_grid(box: np.ndarray, voxel: float) -> Grid:
    """A grid that holds a box `[2, 3]` and what lies within reach of it."""
    margin = TRUNCATION * voxel
    low, high = np.asarray(box[0]) - margin, np.asarray(box[1]) + margin
    x, y, z = (int(count) for count in np.ceil((high - low) / voxel) + 1)
    return Grid(low.astype(np.float32), voxel, (x, y, z))


def fuse_mesh(maps: Maps, grid: Grid) -> Mesh:
    """Fuse depth maps into the distances on a grid, and find their surface with its colors."""
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
