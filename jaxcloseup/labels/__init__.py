"""Pseudo-labels of virtual close-ups."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "config": "LabelConfig pseudo_settings",
        "make": (
            "LabelSources label_sources PseudoSettings PseudoLabel sample_virtual_camera "
            "make_label label_pixels label_views best_source"
        ),
        "rules": "label_depth undivided_label_depth add_label_loss pool_label_loss LabelRule",
    },
)
