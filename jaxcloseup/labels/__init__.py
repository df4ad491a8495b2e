"""Pseudo-labels of virtual close-ups."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "config": "LabelConfig pseudo_settings",
        "make": (
            "LabelSources label_sources PseudoSettings PseudoLabel sample_virtual_camera "
            "sample_closeups make_label label_pixels"
        ),
        "target_views": "best_source label_views render_depths",
        "rules": (
            "LABEL_RULES LabelRule add_label_loss label_depth pool_label_loss undivided_label_depth"
        ),
    },
)
