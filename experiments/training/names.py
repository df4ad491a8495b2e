"""Names that flags accept; importing them must cost nothing, see `define_flags`."""

STAGES = ("baseline", "control", "closeup", "test_time", "detail")
PRESETS = {  # by method; the first one is the default
    "nerf": ("quick", "paper", "released"),
    "surfels": ("quick", "standard", "paper", "reduced", "quick_adaptive", "paper_adaptive"),
}
ARMS = (
    *("baseline", "control", "labels", "mask", "diverse"),
    *("oracle", "resolved", "test_time"),
)
