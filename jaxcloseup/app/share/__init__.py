"""Close-ups of a trained run, and a page that shows them to others."""
