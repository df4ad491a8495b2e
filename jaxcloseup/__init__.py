"""Sharp close-ups of scenes that were only photographed from afar.

Names load their modules on first use, so `import jaxcloseup` is cheap.
"""

from typing import TYPE_CHECKING

from jaxcloseup.lazy import lazy_names


if TYPE_CHECKING:  # type checkers do not follow the lazy list below
    from jaxcloseup.captures.load import load_scene
    from jaxcloseup.fields.contract import RadianceField, Rendering
    from jaxcloseup.fields.splats.render import render_surfels
    from jaxcloseup.fields.splats.surfels import Surfels, surfels_from_points
    from jaxcloseup.geometry.cameras import (
        Camera,
        pixel_grid,
        pixels_to_points,
        pixels_to_rays,
        points_to_pixels,
    )
    from jaxcloseup.geometry.masks import depth_consistent, in_bounds, rgb_consistent
    from jaxcloseup.geometry.poses import (
        PoseSettings,
        closeup_position,
        perturb_rotation,
        sample_anchor,
        sample_closeup_camera,
    )
    from jaxcloseup.geometry.rotations import euler_to_matrix, matrix_to_euler, quaternion_to_matrix
    from jaxcloseup.geometry.warp import ForwardWarp, backward_warp, forward_warp
    from jaxcloseup.labels.config import LabelConfig, pseudo_settings
    from jaxcloseup.labels.make import PseudoLabel, PseudoSettings, make_label
    from jaxcloseup.labels.target_views import best_source, label_views
    from jaxcloseup.photos.scene import Scene, SceneError
    from jaxcloseup.photos.support import find_support
    from jaxcloseup.photos.views import Views
    from jaxcloseup.training.arms import arm_state, run_arms, stack_arms, stack_states
    from jaxcloseup.training.config import TrainConfig
    from jaxcloseup.training.state import TrainState, init_state
    from jaxcloseup.training.steps import closeup_step, pseudo_step, train_step
    from jaxcloseup.version import __version__

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "geometry.cameras": "Camera pixel_grid pixels_to_points pixels_to_rays points_to_pixels",
        "geometry.masks": "depth_consistent in_bounds rgb_consistent",
        "geometry.poses": (
            "PoseSettings closeup_position perturb_rotation sample_anchor sample_closeup_camera"
        ),
        "geometry.rotations": "euler_to_matrix matrix_to_euler quaternion_to_matrix",
        "geometry.warp": "ForwardWarp backward_warp forward_warp",
        "labels.config": "LabelConfig pseudo_settings",
        "labels.make": "PseudoLabel PseudoSettings make_label",
        "labels.target_views": "best_source label_views",
        "fields.contract": "RadianceField Rendering",
        "photos.scene": "Scene SceneError",
        "fields.splats.surfels": "Surfels surfels_from_points",
        "training.arms": "arm_state run_arms stack_arms stack_states",
        "training.state": "TrainState init_state",
        "training.steps": "closeup_step pseudo_step train_step",
        "training.config": "TrainConfig",
        "photos.views": "Views",
        "photos.support": "find_support",
        "captures.load": "load_scene",
        "fields.splats.render": "render_surfels",
        "version": "__version__",
    },
)
