"""Names that users choose from, by flag or by argument; importing them costs nothing."""

FORMATS = ("transforms", "colmap", "llff")  # of captures on disk
SPLITS = ("given", "listed", "every8", "closest", "macro", "zoom")
ALPHA_MODES = ("blend", "mask", "ignore")
CHOICES = ("path", "spread", "first")  # of some of the photographs
