"""Choices and defaults of flags, without heavy imports."""

# COLMAP's camera models; the solver refines them to richer ones.
LENSES = {"perspective": "SIMPLE_RADIAL", "fisheye": "SIMPLE_RADIAL_FISHEYE"}
PAIRINGS = ("exhaustive", "sequential", "retrieval")
MOST_EXHAUSTIVE = 100  # photographs; with more, `auto` matches similar ones only
FEWEST = 3  # photographs that a model needs
COUNT = 100  # frames of a video
LONGEST_SIDE = 3200  # pixels; features of larger photographs are found in reduced ones
