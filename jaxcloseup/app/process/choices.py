"""Names and numbers that flags mention; importing them costs nothing."""

# COLMAP's camera models; the solver goes on to richer ones.
LENSES = {"perspective": "SIMPLE_RADIAL", "fisheye": "SIMPLE_RADIAL_FISHEYE"}
PAIRINGS = ("exhaustive", "sequential", "retrieval")
MOST_EXHAUSTIVE = 100  # photographs; above, `auto` takes the similar ones of each
FEWEST = 3  # photographs that a model needs
COUNT = 100  # frames of a video
