"""What other programs read of a stored run: splats in several formats, and its cameras."""

import math
import pathlib
import re
from collections.abc import Callable, Sequence

import jax
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_run import RunError, StoredRun, restore
from jaxcloseup.artifacts.capture_files import (
    IMAGES,
    MASKS,
    POINTS,
    FileView,
    write_colmap,
    write_mask,
    write_transforms,
)
from jaxcloseup.artifacts.compressed_ply import pack_compressed_ply
from jaxcloseup.artifacts.glb import pack_splats_glb
from jaxcloseup.artifacts.images import to_uint8, write_png
from jaxcloseup.artifacts.spz import pack_spz
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.fields.splats.blending_weights import blending_weights
from jaxcloseup.io.files import write_file
from jaxcloseup.io.placement import Placement
from jaxcloseup.io.ply import write_vertices
from jaxcloseup.photos.pyramids import BUDGET
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Photograph, unpadded
from jaxcloseup.training.state import TrainState


PACKED: dict[str, Callable[..., tuple[bytes, int]]] = {
    "splats.spz": pack_spz,
    "splats.compressed.ply": pack_compressed_ply,
    "splats.glb": pack_splats_glb,
}
_FAINT = 0.25  # share of the splats that SPZ leaves out: those that show least
_BYTES_PER_PIXEL = 4  # of a photograph: colors and weight


def export_splats(
    output_dir: pathlib.Path, record: StoredRun, scene: Scene, stage: str, files: Sequence[str]
) -> None:
    """Write the splats of a stage to files in the capture's coordinates, and print their sizes.

    Files leave out the offset of a far origin and say it themselves; for SPZ, which cannot, it is
    printed.

    Args:
      output_dir: folder to write.
      record: the run.
      scene: its scene.
      stage: whose splats are written.
      files: names, `splats.ply` or those of `PACKED`.

    Raises:
      RunError: the field has no splats.
      CheckpointError: the state does not fit the preset.
    """
    programs, state = restore(record, scene, stage)
    if programs.method.splats is None:
        raise RunError(
            f"{record.folder} was trained with --method={record.preset.method}, which has no "
            "splats: choose --files=cameras"
        )
    surfels, alive = programs.method.splats(state.params, state.buffers)
    for name in files:
        path = output_dir / name
        if name in PACKED:
            kept: np.ndarray | jax.Array = alive
            how: dict[str, bool] = {}
            if name == "splats.spz":
                kept = _shown(programs, state, alive)
                how = {"antialiased": record.preset.field.raster.antialias}
            write_file(path, PACKED[name](surfels, kept, placement=scene.placement, **how)[0])
        else:
            write_surfels(path, surfels, alive, placement=scene.placement)
        print(f"wrote {path}, {path.stat().st_size / 1e6:.1f} MB")
        if name == "splats.spz" and scene.placement.offset.any():
            shift = ", ".join(f"{value:.15g}" for value in scene.placement.offset)
            print(
                f"{path} has the capture's coordinates minus {shift}, then turned so that y is up; "
                "the format has no place to say so"
            )


def _shown(programs: Programs, state: TrainState, alive: jax.Array) -> np.ndarray:
    """Return which splats are alive `[N]`, without those that show least in the photographs."""
    weigh = jax.jit(blending_weights, static_argnums=0)
    with progress.saying("finding the splats that photographs show"):
        cameras = programs.scene.train.cameras
        weights = np.asarray(weigh(programs.field, state.params, state.buffers, cameras))
    living = np.asarray(alive)
    if not living.any():
        return living
    return living & (weights > np.quantile(weights[living], _FAINT))


def export_cameras(output_dir: pathlib.Path, scene: Scene) -> None:
    """Write a capture that other programs read: photographs without distortion, poses, points.

    `images/`, `masks/`, `sparse/0/` (COLMAP) and `transforms.json` (nerfstudio) share `points.ply`.

    Args:
      output_dir: folder to write.
      scene: the scene of a run.

    Raises:
      SceneError: the photographs cannot be read.
      OSError: one sentence that names the path and the reason.
    """
    taken: set[str] = set()
    views = []
    for split, names in scene.names.items():
        with progress.saying(f"reading the photographs of {split}"):
            photographs = _photographs(scene, split)
        for name, photograph in zip(names, photographs, strict=True):
            views.append(_write_view(output_dir, split, name, photograph, taken, scene.placement))
    if any(view.masked for view in views):  # nerfstudio reads masks of all photographs, or of none
        views = [_with_mask(output_dir, view) for view in views]
    points = scene.placement.to_capture(scene.points)
    rgb = to_uint8(scene.rgb[None])[0]
    write_colmap(output_dir / "sparse" / "0", views, points, rgb)
    unit = scene.placement.scale
    near, far = scene.near / unit, scene.far / unit
    write_transforms(output_dir / "transforms.json", views, near=near, far=far)
    colors = [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), [*((axis, "f8") for axis in "xyz"), *colors])
    for i, name in enumerate(rows.dtype.names or ()):
        rows[name] = (points if i < 3 else rgb)[:, i % 3]
    write_vertices(output_dir / POINTS, rows)
    print(f"wrote {output_dir}, {len(views)} photographs and {len(points)} points")


def _photographs(scene: Scene, split: str) -> list[Photograph]:
    """Return the photographs of a split at their own size, or as fine as they fit into memory."""
    reduced = unpadded(getattr(scene, split), scene.sizes(split))
    if scene.photographs_at is None:
        return reduced
    coarse = scene.metadata.get("downscale", 1)
    pixels = sum(photo.rgb.shape[0] * photo.rgb.shape[1] for photo in reduced) * coarse**2
    divisor = max(1, math.ceil(math.sqrt(pixels * _BYTES_PER_PIXEL / BUDGET)))
    if divisor >= coarse:
        return reduced
    if divisor > 1:
        print(f"the photographs of {split} are written at 1/{divisor} of their size, to fit memory")
    return scene.photographs_at(divisor, split)


def _write_view(
    output_dir: pathlib.Path,
    split: str,
    name: str,
    photograph: Photograph,
    taken: set[str],
    placement: Placement,
) -> FileView:
    """Write a photograph, and its mask if it has one, under a name that no other one has."""
    # Programs that read COLMAP's text cut names at spaces.
    stem = re.sub(r"[^\w.-]", "_", name)
    while stem in taken:
        stem = f"{split}_{stem}"
    taken.add(stem)
    camera, weight = photograph.camera, np.asarray(photograph.weight)
    shown = weight >= (128 if weight.dtype == np.uint8 else 0.5)
    write_png(output_dir / IMAGES / f"{stem}.png", photograph.rgb)
    if not shown.all():
        write_mask(output_dir / MASKS / f"{stem}.png", shown)
    return FileView(
        name=f"{stem}.png",
        split=split,
        camtoworld=placement.poses_to_capture(np.asarray(camera.camtoworld)),
        intrinsics=np.asarray(camera.intrinsics, np.float64),
        height=photograph.rgb.shape[0],
        width=photograph.rgb.shape[1],
        masked=not shown.all(),
    )


def _with_mask(output_dir: pathlib.Path, view: FileView) -> FileView:
    """Write a white mask for a photograph that has none."""
    if not view.masked:
        write_mask(output_dir / MASKS / view.name, np.ones((view.height, view.width), bool))
    return view._replace(masked=True)
