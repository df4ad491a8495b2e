"""Sharp close-ups of scenes that were only photographed from afar.

Names load their modules on first use, so `import jaxcloseup` is cheap.
"""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "geometry.cameras": "Camera",
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
