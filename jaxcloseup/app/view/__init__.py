"""Rendering and viewing a stored run: camera paths, frames, and the viewer's page."""
