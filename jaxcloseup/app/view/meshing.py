"""The surface of a run as a mesh in a file, and how far it is from the exact surface."""

import math
import pathlib
import time
from typing import Any

import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.kept_detail import detail_path, find_detail
from jaxcloseup.app.score.mesh_error import CLOSE, mesh_error
from jaxcloseup.app.store.stored_run import StoredRun, restore
from jaxcloseup.app.view import surface
from jaxcloseup.app.view.texturing import lay_out, texture_mesh
from jaxcloseup.artifacts.glb import pack_mesh_glb
from jaxcloseup.artifacts.mesh_files import write_mesh
from jaxcloseup.io.files import write_file, write_json
from jaxcloseup.io.memory import installed_memory
from jaxcloseup.io.placement import Placement
from jaxcloseup.photos.scene import Scene


class MeshError(Exception):
    """There can be no such mesh. The message is one sentence that says what to do."""


def write_run_mesh(
    output_dir: pathlib.Path,
    record: StoredRun,
    scene: Scene,
    stage: str | None,
    *,
    region: np.ndarray | None,
    voxel: float | None,
    resolution: int,
    min_views: int,
    texture: int | None = None,
) -> None:
    """Fuse depth maps of the training views, and write `mesh.ply` and `mesh.json`.

    Args:
      output_dir: folder to write.
      record: the run.
      scene: its scene.
      stage: whose depth is fused; None: the exact depth of a built-in scene.
      region: `[2, 3]` smallest and largest coordinates, the capture's; None: of what views see.
      voxel: side of a voxel in the capture's unit; None: by `resolution`.
      resolution: voxels along the longest side of the region.
      min_views: training views that must see the surface at a pixel.
      texture: largest side of the texture of `mesh.glb`; None: no such file.

    Raises:
      TextureError: the mesh has too many triangles for the texture.
      MeshError: no surface is seen or lies in the region, or it needs too much memory.
    """
    if stage is None and scene.surface is None:
        raise MeshError("--exact needs a built-in scene, whose surface is known: leave it out")
    finer = surface.finer_by(scene, renders_pixels=False)
    if stage is None:
        see = surface.exact_view(scene)
    else:
        programs, state = restore(record, scene, stage)
        see = surface.rendered_view(programs, state)
        finer = surface.finer_by(scene, renders_pixels=programs.method.renders_pixels)
    maps = surface.see_training_views(scene, see, finer=finer, support=min_views)
    region = _seen_region(maps, min_views) if region is None else scene.placement.to_scene(region)
    side = scene.placement.scale * voxel if voxel else np.ptp(region, axis=0).max() / resolution
    mesh = _fuse(maps, surface.make_grid(region, side), scene.placement.scale)
    if texture is not None and stage is not None:
        atlas = lay_out(mesh, texture)  # before minutes of detail, because it may not fit
        detail, _ = find_detail(programs, state, detail_path(record.folder, stage))
        textured = texture_mesh(mesh, atlas, detail)
        write_file(output_dir / "mesh.glb", pack_mesh_glb(textured, placement=scene.placement))
    write_mesh(output_dir / "mesh.ply", mesh, scene.placement)
    about = {
        "stage": stage,
        **_in_capture(side, region, scene.placement),
        "min_views": min_views,
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "error": _measure(scene, mesh, finer),
    }
    write_json(output_dir / "mesh.json", about)
    paths = ", ".join(map(str, sorted(output_dir.glob("mesh.[!j]*"))))
    print(f"mesh: {paths}, {len(mesh.faces)} triangles")


def _seen_region(maps: surface.Maps, min_views: int) -> np.ndarray:
    """Return the smallest and largest coordinates `[2, 3]` of what views see, in the scene."""
    points = surface.seen_points(maps.views.cameras, maps.depths, maps.views.weight)
    if not len(points):
        raise MeshError(
            f"no pixel shows a surface that {min_views} training views see: choose a smaller "
            "--min_views"
        )
    box = surface.box_around(points)
    if not np.ptp(box, axis=0).max() > 0:
        raise MeshError("all that views see is one point: choose a smaller --min_views")
    return box


def _in_capture(voxel: float, region: np.ndarray, placement: Placement) -> dict[str, Any]:
    """Return a voxel's side, a region and what `mesh.ply` leaves out, as the capture has them."""
    box = placement.to_capture(region)
    offset = placement.offset
    return {"voxel": voxel / placement.scale, "region": box.tolist(), "offset": offset.tolist()}


def _fuse(maps: surface.Maps, grid: surface.Grid, unit: float) -> surface.Mesh:
    """Return the mesh of a grid; `unit` is the capture's."""
    _check_memory(grid)
    counts = " x ".join(map(str, grid.shape))
    what = f"{len(maps.depths)} depth maps into {counts} voxels of {grid.voxel / unit:.3g}"
    began = time.perf_counter()
    with progress.saying(f"fusing {what}"):
        mesh = surface.fuse_mesh(maps, grid)
    print(f"fused {what} in {time.perf_counter() - began:.0f} s")
    if not len(mesh.faces):
        raise MeshError(
            "no surface lies in the region: choose another --region, smaller voxels or a smaller "
            "--min_views"
        )
    return mesh


def _measure(scene: Scene, mesh: surface.Mesh, finer: int) -> dict[str, float] | None:
    """Return how far the mesh is from the exact surface, where that is known; print it too."""
    if scene.surface is None:
        return None
    with progress.saying("comparing with the exact surface that the training views see"):
        error = mesh_error(mesh, surface.exact_points(scene, finer))
    print(
        f"Chamfer distance {error['chamfer']:.4f} (mesh to surface {error['mesh_to_surface']:.4f}, "
        f"surface to mesh {error['surface_to_mesh']:.4f}) at an extent of {error['extent']:.2f}; "
        f"{error['mesh_close']:.1%} of the mesh and {error['surface_close']:.1%} of the surface "
        f"are within {CLOSE:.0%} of the extent of each other"
    )
    return error


def _check_memory(grid: surface.Grid) -> None:
    needed = math.prod(grid.shape) * surface.BYTES_PER_VOXEL
    if needed > (held := installed_memory()):
        raise MeshError(
            f"{' x '.join(map(str, grid.shape))} voxels take {needed / 2**30:.1f} GiB, but this "
            f"computer has {held / 2**30:.1f}: choose a smaller --resolution, larger --voxel or "
            "smaller --region"
        )
