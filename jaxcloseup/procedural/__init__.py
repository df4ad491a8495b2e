"""Built-in scenes, drawn by ray casting, with exact depth at any pose."""

from jaxcloseup.procedural.loading import PROCEDURAL_SCENES, procedural_scene


__all__ = ["PROCEDURAL_SCENES", "procedural_scene"]
