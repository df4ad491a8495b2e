"""Captures from disk: formats, lenses, masks, splits, and a cache of reduced photographs."""
