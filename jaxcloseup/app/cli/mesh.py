"""Write the surface of a run as a colored triangle mesh, in the capture's coordinates.

    jaxcloseup mesh --run=outputs/table/surfels/...

The depth that the run renders in each training view is fused into signed distances on a grid, and
marching cubes finds the surface where these are 0. Pixels do not count whose surface fewer than
`--min_views` training views see. The mesh ends where no view says anything. `--texture` also writes
it as GLB, with a texture of the photographs' colors. On built-in scenes the program also measures
how far the mesh is from the exact surface; `--exact` fuses exact depth instead, which shows what
fusion alone costs. The program needs the extra "mesh".
"""

import importlib.util
import math
import sys
from typing import TYPE_CHECKING

from absl import flags

from jaxcloseup.app.cli.flags import OUTPUT, STORED_RUN, run_from_flags
from jaxcloseup.app.cli.invocation import program_name
from jaxcloseup.app.cli.output_folder import check_unused, dated, prepare_to_stop
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


if TYPE_CHECKING:
    import numpy as np

FLAGS = flags.FLAGS
share(STORED_RUN, OUTPUT)
flags.DEFINE_integer(
    "resolution",
    256,
    "voxels along the longest side of the region",
    lower_bound=8,
    upper_bound=4096,
)
flags.DEFINE_float("voxel", None, "side of a voxel in the capture's unit, in place of --resolution")
flags.DEFINE_list(
    "region",
    None,
    "x0,y0,z0,x1,y1,z1: smallest and largest coordinates of the mesh; default: the bounds of "
    "what the training views see, without the farthest 0.5 % on each side",
)
flags.DEFINE_integer(
    "min_views",
    3,
    "training views that must see the surface at a pixel for it to count, its own included",
    lower_bound=1,
)
flags.DEFINE_integer(
    "texture",
    None,
    "also write mesh.glb, with a texture of the photographs' colors of at most so many pixels a "
    "side, such as 4096",
    lower_bound=256,
    upper_bound=16384,
)
flags.DEFINE_bool("exact", False, "fuse the exact depth of a built-in scene, not the run's")


def main(_: list[str]) -> None:
    """Write the mesh of the run that the flags name."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.store.stored_run import RunError, load_run_scene
        from jaxcloseup.app.view.meshing import MeshError, write_run_mesh
        from jaxcloseup.app.view.texturing import TextureError
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    if importlib.util.find_spec("skimage") is None:
        name = program_name("mesh")
        sys.exit(f'{name}: scikit-image is missing: install jaxcloseup with the extra "mesh"')
    expected = (MeshError, TextureError, RunError, SceneError, CheckpointError, TrainingError)
    with in_one_sentence("mesh", *expected, OSError), progress.showing():
        # Cheap checks come before loading the scene and the state.
        region = _region()
        if FLAGS.voxel is not None and not 0 < FLAGS.voxel < math.inf:
            raise MeshError(f"--voxel={FLAGS.voxel:g} must be a length above 0")
        if FLAGS.exact and FLAGS.texture is not None:
            raise MeshError("--texture needs the run's depth: leave out --exact")
        record, stage = run_from_flags()
        output_dir = check_unused(FLAGS.output_dir or dated(record.folder / "meshes"))
        prepare_to_stop(output_dir)
        write_run_mesh(
            output_dir,
            record,
            load_run_scene(record, FLAGS.data),
            None if FLAGS.exact else stage,
            region=region,
            voxel=FLAGS.voxel,
            resolution=FLAGS.resolution,
            min_views=FLAGS.min_views,
            texture=FLAGS.texture,
        )


def _region() -> "np.ndarray | None":
    import numpy as np

    from jaxcloseup.app.view.meshing import MeshError

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
