"""Write what a run produces: images, videos, surfels and meshes as PLY files, and checkpoints.

`checkpoints` is not re-exported, because Orbax is slow to import.
"""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "images": (
            "Image color_counts colorize_depth colorize_error colorize_normals "
            "colorize_support encode_png encode_webp_animation side_by_side to_uint8 "
            "webp_data_uri write_png"
        ),
        "mesh_files": "Mesh surface_mesh write_mesh",
        "surfel_ply": "read_surfels write_surfels",
        "video": "write_video",
        "viewer_gaussians": "Gaussians as_gaussians",
    },
)
