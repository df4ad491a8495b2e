"""The methods, one module each, and what they and their presets hold."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {"method": "CoarseConfig Method Preset TargetConfig WindowConfig", "registry": "METHODS"},
)
