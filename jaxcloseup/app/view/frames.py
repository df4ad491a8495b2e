"""Render the frames of a camera path: color, depth, normals and support as images."""

import functools
import pathlib
from collections.abc import Sequence

import jax
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.exposed import expose, how_taken
from jaxcloseup.app.run.kept_detail import detailed
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.view.camera_paths import Shots, named_cameras
from jaxcloseup.artifacts.images import (
    Image,
    colorize_depth,
    colorize_expected_error,
    colorize_normals,
    colorize_support,
    write_png,
)
from jaxcloseup.detail.add import Detail
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.make import LabelSources
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.exposures import Taken
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.support import find_support
from jaxcloseup.training.state import TrainState


SOLID = 0.5  # opacity of a pixel that shows the scene
_LARGE = 200_000  # pixels of an image whose support is found at every second pixel and row
_support = jax.jit(find_support)


def render_shots(
    output_dir: pathlib.Path,
    programs: Programs,
    state: TrainState,
    shots: Shots,
    *,
    sources: LabelSources | None,
    detail: Detail | None = None,
) -> list[pathlib.Path]:
    """Write `<kind>/<name>.png` for every camera, and return the folders.

    Args:
      output_dir: folder for `rgb`, `depth`, `normals` (from fields that render them), `support`,
        `trust` and `error`.
      programs: the run's compiled programs.
      state: the state to render.
      shots: the cameras.
      sources: the training photographs with their depths, or None to leave out support.
      detail: detail of the state, or None to render the state alone.
    """
    scene = programs.scene
    cameras = named_cameras(shots)
    # Three frames set the depth colors of all frames, so that videos do not flicker.
    some = {0, len(cameras) // 2, len(cameras) - 1}
    depths = [
        label_depth(programs.render(state, cameras[i][1]), near=0, far=scene.far) for i in some
    ]
    limits = depth_range(depths, scene)
    picture = functools.partial(
        draw_pictures, programs, sources=sources, detail=detail, limits=limits
    )
    sizes = shots.sizes or [(shots.cameras.width, shots.cameras.height)] * len(cameras)
    images: dict[str, Image] = {}
    empty = 0

    def draw(
        frame: tuple[tuple[str, Camera], tuple[int, int]],
    ) -> tuple[str, dict[str, Image], bool]:
        (name, camera), size = frame
        camera = camera.replace(width=size[0], height=size[1])
        seen = programs.render(state, camera)
        images = picture(seen, camera, taken=how_taken(programs, shots.split, name))
        return name, images, not np.any(np.asarray(seen.alpha) >= SOLID)

    frames = list(zip(cameras, sizes, strict=True))
    largest = max(width * height for width, height in sizes)
    drawn = progress.each(draw, frames, "rendering frames", pixels=largest)
    for name, images, shows_nothing in drawn:
        empty += shows_nothing
        for kind, image in images.items():
            write_png(output_dir / kind / f"{name}.png", image)
    if empty:
        which = f"{empty} of {len(cameras)}" if empty < len(cameras) else "all"
        print(
            f"{which} frames show nothing of the scene: their cameras look past it, or the path is "
            "in the coordinates of another program (see --camera_transform)"
        )
    return [output_dir / kind for kind in images]


def draw_pictures(
    programs: Programs,
    seen: Rendering,
    camera: Camera,
    *,
    sources: LabelSources | None,
    detail: Detail | None = None,
    limits: tuple[float, float] | None = None,
    taken: Taken | None = None,
) -> dict[str, Image]:
    """Return a camera's images by kind: `rgb`, `depth`, `normals`, `support`, `trust`, `error`.

    `normals` needs a field that renders them, `support` needs `sources`, and two need `detail`:
    `trust`, the share of the photographs' detail that was added, from black to white, and `error`,
    the expected error.

    Args:
      programs: the run's compiled programs.
      seen: their rendering of `camera`.
      camera: camera of the images.
      sources: the training photographs with their depths, or None to leave out support.
      detail: detail of the state, or None to draw the state alone.
      limits: nearest and farthest depth of the color scale; default: `depth_range` of the image.
      taken: how the camera's photograph was taken, see `expose`.
    """
    scene = programs.scene
    depth = label_depth(seen, near=0, far=scene.far)
    near, far = limits or depth_range([depth], scene)
    solid = np.asarray(seen.alpha) >= SOLID
    depth_colors = colorize_depth(seen.depth, near=near, far=far, valid=solid)
    images: dict[str, Image] = {"rgb": seen.rgb, "depth": depth_colors}
    if seen.normal is not None:
        images["normals"] = colorize_normals(np.where(solid[..., None], seen.normal, 0))
    if sources is not None:
        count, footprint = _support_of(camera, depth, sources)
        # Detail and windows show the photographs' own pixels, and sources are reduced.
        reduced = scene.metadata.get("downscale", 1) if scene.photographs_at else 1
        images["support"] = colorize_support(count, footprint / reduced)
    if detail is not None:
        sharper = detailed(programs, detail, camera, seen)
        images |= {"rgb": sharper.rgb, "trust": np.asarray(sharper.weight)}
        images["error"] = colorize_expected_error(sharper.error)
    images["rgb"] = np.asarray(expose(programs, images["rgb"], seen, taken))
    return images


def _support_of(camera: Camera, depth: jax.Array, sources: LabelSources) -> list[np.ndarray]:
    """Return count and footprint of an image's support, which repeat in a large image.

    The depth maps of the photographs, which decide it, are coarser still.
    """
    step = 2 if depth.size > _LARGE else 1
    pixels, some = pixel_grid(*depth.shape)[::step, ::step], depth[::step, ::step]
    found = jax.device_get(_support(camera, pixels, some, sources.views, sources.depths))
    repeated = (part.repeat(step, axis=0).repeat(step, axis=1) for part in found)
    return [part[: depth.shape[0], : depth.shape[1]] for part in repeated]


def depth_range(depths: Sequence[jax.Array], scene: Scene) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the depths; the scene's near and far if all are 0.

    A depth of 0 is undefined and does not count.
    """
    known = np.concatenate([np.asarray(depth).ravel() for depth in depths])
    known = known[known > 0]
    if not len(known):
        return scene.near, scene.far
    low, high = np.percentile(known, [1, 99])
    return float(low), float(high)
