"""Load captures from disk: formats, lenses, masks, splits, and a cache of shrunk photographs."""

from jaxcloseup.captures.formats import FORMATS
from jaxcloseup.captures.images import read_image, read_mask
from jaxcloseup.captures.json_fields import number, read_object, rigid_transform
from jaxcloseup.captures.loading import load_capture
from jaxcloseup.captures.photo_reading import ALPHA_MODES, Reading
from jaxcloseup.captures.splits import SPLITS


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
