"""Cameras, rotations, virtual poses, warps and masks: usable alone in any JAX project.

Conventions of every module:

- Camera frame: OpenCV, x right, y down, z forward; poses are camera-to-world.
- Pixels: continuous (x, y); the center of the top-left pixel is (0.5, 0.5).
- Depth: z-depth in world units, 0 where undefined.
- Sizes: height before width, as in an array's shape. Functions take `height, width`, the fields of
  `Camera`; only `forward_warp`, which has no camera, takes both in one as `shape=(height, width)`.
- Results: `values` is what a warp carried over, `hit` says where anything was, `pixels` and `depth`
  where it comes from.
- Batches: functions take one camera; batch cameras with `jax.vmap`.
"""

from jaxcloseup.geometry.cameras import (
    Camera,
    crop_camera,
    mean_focal,
    pixel_grid,
    pixels_to_points,
    pixels_to_rays,
    points_to_pixels,
)
from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent
from jaxcloseup.geometry.poses import (
    PoseSettings,
    closeup_position,
    four_anchors,
    perturb_rotation,
    sample_anchor,
    sample_closeup_camera,
)
from jaxcloseup.geometry.rotations import (
    euler_to_matrix,
    matrix_to_euler,
    quaternion_rows,
    quaternion_to_matrix,
)
from jaxcloseup.geometry.union_warp import SourceBlocks, block_sources, union_warp
from jaxcloseup.geometry.visibility import VisiblePoints, sample_where_visible, sphere_in_view
from jaxcloseup.geometry.warp import (
    BackwardWarp,
    ForwardWarp,
    backward_warp,
    draw_nearest,
    forward_warp,
    reads_unmixed,
    warp_forward_to,
    warp_to,
)


__all__ = [
    "BackwardWarp",
    "Camera",
    "ForwardWarp",
    "PoseSettings",
    "SourceBlocks",
    "VisiblePoints",
    "backward_warp",
    "block_sources",
    "closeup_position",
    "crop_camera",
    "depth_consistent",
    "draw_nearest",
    "euler_to_matrix",
    "forward_warp",
    "four_anchors",
    "in_bounds",
    "matrix_to_euler",
    "mean_focal",
    "perturb_rotation",
    "pixel_grid",
    "pixels_to_points",
    "pixels_to_rays",
    "points_to_pixels",
    "quaternion_rows",
    "quaternion_to_matrix",
    "reads_unmixed",
    "rgb_consistent",
    "sample_anchor",
    "sample_closeup_camera",
    "sample_where_visible",
    "sphere_in_view",
    "union_warp",
    "warp_forward_to",
    "warp_to",
]
