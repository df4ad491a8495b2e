"""Host side, what comes in: captures from disk and procedural scenes."""

from jaxcloseup.scenes.captures import load_scene
from jaxcloseup.scenes.errors import SceneError, SceneWarning
from jaxcloseup.scenes.scene import Scene, Surface


__all__ = ["Scene", "SceneError", "SceneWarning", "Surface", "load_scene"]
