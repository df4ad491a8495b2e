"""Sharp close-ups of scenes that were only photographed from afar.

Names load their modules on first use, so `import jaxcloseup.geometry` stays cheap.
"""

import importlib
from typing import Any

from jaxcloseup.version import __version__


_MODULE_OF = {
    "Camera": "jaxcloseup.geometry.cameras",
    "PseudoLabel": "jaxcloseup.pseudo",
    "PseudoSettings": "jaxcloseup.pseudo",
    "RadianceField": "jaxcloseup.field",
    "Rendering": "jaxcloseup.field",
    "Scene": "jaxcloseup.scene",
    "SceneError": "jaxcloseup.scene",
    "Surfels": "jaxcloseup.splats.surfels",
    "TrainConfig": "jaxcloseup.train",
    "TrainState": "jaxcloseup.train",
    "Views": "jaxcloseup.photographs",
    "best_source": "jaxcloseup.pseudo",
    "find_support": "jaxcloseup.support",
    "init_state": "jaxcloseup.train",
    "label_views": "jaxcloseup.pseudo",
    "load_scene": "jaxcloseup.scenes",
    "make_label": "jaxcloseup.pseudo",
    "pseudo_step": "jaxcloseup.train",
    "render_surfels": "jaxcloseup.splats.render",
    "surfels_from_points": "jaxcloseup.splats.surfels",
    "train_step": "jaxcloseup.train",
}

__all__ = [
    "Camera",
    "PseudoLabel",
    "PseudoSettings",
    "RadianceField",
    "Rendering",
    "Scene",
    "SceneError",
    "Surfels",
    "TrainConfig",
    "TrainState",
    "Views",
    "__version__",
    "best_source",
    "find_support",
    "init_state",
    "label_views",
    "load_scene",
    "make_label",
    "pseudo_step",
    "render_surfels",
    "surfels_from_points",
    "train_step",
]


def __getattr__(name: str) -> Any:
    """Import the module of a re-exported name when the name is first used (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxcloseup' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
