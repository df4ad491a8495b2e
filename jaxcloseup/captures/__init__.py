"""Load captures from disk: formats, lenses, masks, splits, and a cache of shrunk photographs."""

from jaxcloseup.captures.images import read_image, read_mask
from jaxcloseup.captures.json_fields import number, read_object, rigid_transform
from jaxcloseup.captures.loading import load_capture
from jaxcloseup.captures.photo_reading import Reading
from jaxcloseup.choices import ALPHA_MODES, FORMATS, SPLITS


__all__ = [
    "ALPHA_MODES",
    "FORMATS",
    "SPLITS",
    "Reading",
    "load_capture",
    "number",
    "read_image",
    "read_mask",
    "read_object",
    "rigid_transform",
]
