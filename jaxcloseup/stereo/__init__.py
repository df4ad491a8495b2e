"""Multi-view stereo: depth and normal maps of photographs with poses, before any field."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "config": "StereoConfig",
        "consistency": "Confirmed count_consistent",
        "stereo_maps": "StereoMaps estimate_depths",
        "matching": "Photographs match_planes pack_photographs",
        "neighbors": "choose_neighbors",
        "planes": "Relative plane_normals relative_transforms shift_planes",
    },
)
