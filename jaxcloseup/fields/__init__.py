"""Radiance fields: their contract, splats, and volumes."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(__name__, {"contract": "Rendering RadianceField"})
