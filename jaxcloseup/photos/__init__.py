"""Training photographs: views, pyramids, windows, and what they show of other views."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "views": (
            "Views Photograph Measured Batch unpadded to_float camera_at sample_pixels sample_image"
        ),
        "scene": (
            "SceneError SceneWarning UnknownKeyWarning ImageSizeWarning NearFarWarning "
            "DuplicateFileWarning PointsWarning Surface Scene keep_photographs move_photographs"
        ),
        "pyramids": "Pyramid scene_pyramid photograph_pyramid fractional_level read_pyramid",
        "windows": (
            "Windows photograph_windows view_windows windows_that_see sample_window "
            "sample_window_pixels cut_window in_quarters"
        ),
        "light": "to_light to_colors change_exposure light_by_curve colors_by_curve",
        "exposures": (
            "Exposures Taken Metering look_at_points solve_gains meter fit_metering predict_gain "
            "at_middle_exposure take"
        ),
        "responses": "fit_response straighten",
        "stated_exposures": "StatedExposure fit_cameras gains_of_files",
        "gather": "gather_parts",
        "gather_sums": "GatherSettings Gathered Reader gather_points",
        "alignment": "estimate_motion halves_agree move_camera shift_between",
        "support": "Support find_support count_seen",
        "proximity": "Proximity measure_proximity",
        "depth_maps": "GatherSources gather_sources join_maps read_depths read_pixel_depths",
        "fusion": "DepthMaps Fused fuse fuse_grid prepare_depth_maps",
    },
)
