"""Load captures from disk: formats, lenses, masks, splits, and a cache of shrunk photographs."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "choices": "ALPHA_MODES CHOICES FORMATS SPLITS",
        "folder": "load_capture",
        "json_fields": "number read_object rigid_transform",
        "load": "load_scene",
        "mask_values": "read_mask",
        "photo_files": "read_image",
        "photo": "Reading",
    },
)
