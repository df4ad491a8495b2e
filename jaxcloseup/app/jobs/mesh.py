"""The surface of a run as a mesh: what `experiments.mesh` does."""

import datetime
import importlib.util
import math
import sys
import time

import numpy as np
from absl import flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli.start import check_unused, prepare_to_stop, set_up
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.score.mesh_error import CLOSE, mesh_error
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, restore
from jaxcloseup.app.view import surface
from jaxcloseup.app.view.chosen_run import run_from_flags
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.artifacts.mesh_files import write_mesh
from jaxcloseup.io.files import write_json
from jaxcloseup.io.memory import installed_memory
from jaxcloseup.photos.scene import Scene, SceneError


FLAGS = flags.FLAGS


class MeshError(Exception):
    """There can be no such mesh. The message is one sentence that says what to do."""


def main() -> None:
    """Write the mesh of the run that the flags name."""
    set_up()
    if importlib.util.find_spec("skimage") is None:
        sys.exit(
            'experiments.mesh: scikit-image is missing: install jaxcloseup with the extra "mesh"'
        )
    try:
        with progress.showing():
            _mesh()
    except (
        *(MeshError, RunError, SceneError),
        *(CheckpointError, TrainingError, OSError),
    ) as error:
        sys.exit(f"experiments.mesh: {error}")


def _mesh() -> None:
    # Cheap checks come before loading the scene and the state.
    region = _region()
    if FLAGS.voxel is not None and not 0 < FLAGS.voxel < math.inf:
        raise MeshError(f"--voxel={FLAGS.voxel:g} must be a length above 0, in world units")
    record, stage = run_from_flags()
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
    output_dir = check_unused(FLAGS.output_dir or record.folder / "meshes" / stamp)
    prepare_to_stop(output_dir)
    scene = load_run_scene(record, FLAGS.data)
    if FLAGS.exact and scene.surface is None:
        raise MeshError("--exact needs a built-in scene, whose surface is known: leave it out")
    finer = surface.finer_by(scene, renders_pixels=False)
    if FLAGS.exact:
        see = surface.exact_view(scene)
    else:
        programs, state = restore(record, scene, stage)
        see = surface.rendered_view(programs, state)
        finer = surface.finer_by(scene, renders_pixels=programs.method.renders_pixels)
    maps = surface.see_training_views(scene, see, finer=finer, support=FLAGS.min_views)
    if region is None:
        points = surface.seen_points(maps.views.cameras, maps.depths, maps.views.weight)
        if not len(points):
            raise MeshError(
                f"no pixel shows a surface that {FLAGS.min_views} training views see: choose a "
                "smaller --min_views"
            )
        region = surface.box_around(points)
    grid = surface.make_grid(region, FLAGS.voxel or np.ptp(region, axis=0).max() / FLAGS.resolution)
    _check_memory(grid)
    counts = " x ".join(map(str, grid.shape))
    what = f"{len(maps.depths)} depth maps into {counts} voxels of {grid.voxel:.3g}"
    began = time.perf_counter()
    with progress.saying(f"fusing {what}"):
        mesh = surface.fuse_mesh(maps, grid)
    print(f"fused {what} in {time.perf_counter() - began:.0f} s")
    if not len(mesh.faces):
        raise MeshError(
            "no surface lies in the region: choose another --region, smaller voxels or a smaller "
            "--min_views"
        )
    write_mesh(output_dir / "mesh.ply", mesh)
    about = {
        "stage": None if FLAGS.exact else stage,
        "voxel": grid.voxel,
        "region": np.asarray(region).tolist(),
        "min_views": FLAGS.min_views,
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "error": _measure(scene, mesh, finer),
    }
    write_json(output_dir / "mesh.json", about)
    print(f"mesh: {output_dir / 'mesh.ply'}, {len(mesh.faces)} triangles")


def _measure(scene: Scene, mesh: surface.Mesh, finer: int) -> dict[str, float] | None:
    """How far the mesh is from the exact surface, where that is known; printed too."""
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


def _region() -> np.ndarray | None:
    if FLAGS.region is None:
        return None
    try:
        box = np.array(list(map(float, FLAGS.region))).reshape(2, 3)
        if not (np.isfinite(box).all() and (box[0] < box[1]).all()):
            raise ValueError
    except ValueError:
        raise MeshError(
            f"--region={','.join(FLAGS.region)} must be six finite numbers x0,y0,z0,x1,y1,z1, the "
            "smallest coordinates before the largest"
        ) from None
    return box


def _check_memory(grid: surface.Grid) -> None:
    needed = math.prod(grid.shape) * surface.BYTES_PER_VOXEL
    if needed > (held := installed_memory()):
        raise MeshError(
            f"{' x '.join(map(str, grid.shape))} voxels take {needed / 2**30:.1f} GiB, but this "
            f"computer has {held / 2**30:.1f}: choose a smaller --resolution, larger --voxel or "
            "smaller --region"
        )
