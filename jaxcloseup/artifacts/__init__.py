"""Write what a run produces: images, videos, surfels and meshes as PLY files, and checkpoints.

`checkpoints` is not re-exported, because Orbax is slow to import.
"""

from jaxcloseup.artifacts.gaussians import Gaussians, as_gaussians
from jaxcloseup.artifacts.images import (
    Image,
    color_counts,
    colorize_depth,
    colorize_error,
    colorize_normals,
    colorize_support,
    encode_png,
    encode_webp_animation,
    side_by_side,
    to_uint8,
    webp_data_uri,
    write_png,
)
from jaxcloseup.artifacts.mesh import Mesh, surface_mesh, write_mesh
from jaxcloseup.artifacts.surfel_ply import read_surfels, write_surfels
from jaxcloseup.artifacts.video import write_video


__all__ = [
    "Gaussians",
    "Image",
    "Mesh",
    "as_gaussians",
    "color_counts",
    "colorize_depth",
    "colorize_error",
    "colorize_normals",
    "colorize_support",
    "encode_png",
    "encode_webp_animation",
    "read_surfels",
    "side_by_side",
    "surface_mesh",
    "to_uint8",
    "webp_data_uri",
    "write_mesh",
    "write_png",
    "write_surfels",
    "write_video",
]
