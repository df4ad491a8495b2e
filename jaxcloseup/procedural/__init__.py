"""Built-in scenes, drawn by ray casting, with exact depth at any pose."""
