"""Built-in scenes, drawn by ray casting, with exact depth at any pose."""

from jaxcloseup.drawn_scenes.drawn import PROCEDURAL_SCENES, procedural_scene


__all__ = ["PROCEDURAL_SCENES", "procedural_scene"]
