"""Looking at a stored run: cameras, frames, and the viewer's page."""
