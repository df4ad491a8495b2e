"""Built-in scenes, drawn by ray casting, with exact depth at any pose."""

from jaxcloseup.drawn_scenes.drawn import DRAWN_SCENES, draw_scene


__all__ = ["DRAWN_SCENES", "draw_scene"]
