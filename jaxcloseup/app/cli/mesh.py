"""Write the surface of a run as a colored triangle mesh, in the capture's coordinates.

    python -m experiments.mesh --run=outputs/table/surfels/...

The depth that the run renders in each training view is fused into signed distances on a grid, and
marching cubes finds the surface where these are 0. Pixels do not count whose surface fewer than
`--min_views` training views see. The mesh ends where no view says anything. On built-in scenes the
program also measures how far the mesh is from the exact surface; `--exact` fuses exact depth
instead, which shows what fusion alone costs. The program needs the extra "mesh".
"""

from absl import flags

from jaxcloseup.app.cli import view_flags as define_flags
from jaxcloseup.app.cli.start import job


flags.adopt_module_key_flags(define_flags)  # these are in --help too
flags.declare_key_flag("output_dir")
flags.DEFINE_integer(
    "resolution",
    256,
    "voxels along the longest side of the region",
    lower_bound=8,
    upper_bound=4096,
)
flags.DEFINE_float("voxel", None, "side of a voxel in world units, in place of --resolution")
flags.DEFINE_list(
    "region",
    None,
    "x0,y0,z0,x1,y1,z1: smallest and largest coordinates of the mesh; default: of what the "
    "training views see, but for the farthest 0.5 % on each side",
)
flags.DEFINE_integer(
    "min_views",
    3,
    "training views that must see the surface at a pixel for it to count, its own included",
    lower_bound=1,
)
flags.DEFINE_bool("exact", False, "fuse the exact depth of a built-in scene, not the run's")


def main(_: list[str]) -> None:
    """Write the mesh of the run that the flags name."""
    job("mesh").main()
