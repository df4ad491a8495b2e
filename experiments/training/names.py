"""Names that flags accept; importing them must cost nothing, see `define_flags`."""

STAGES = ("baseline", "control", "closeup", "detail", "test_time")
PRESETS = {  # by method; the first one is the default
    "nerf": ("quick", "paper", "released"),
    "dsnerf": ("quick", "paper"),
    "ngp": ("quick", "paper"),
    "surfels": ("quick", "standard", "paper", "reduced", "quick_adaptive", "paper_adaptive"),
    "gaussians": ("quick", "paper", "quick_adaptive", "paper_mcmc"),
    "mip_gaussians": ("quick", "paper", "quick_adaptive", "paper_mcmc"),
}
METHODS = {
    "nerf": "a coarse and a fine network (Mildenhall et al. 2020)",
    "dsnerf": "the NeRF with depth from the capture's points (Deng et al. 2022)",
    "ngp": "a hash grid, cut by proposals (Müller et al. 2022)",
    "surfels": "2-D Gaussian splatting (Huang et al. 2024)",
    "gaussians": "3-D Gaussian splatting (Kerbl et al. 2023)",
    "mip_gaussians": "3-D Gaussians with filters against aliasing (Yu et al. 2024)",
}
ARMS = (
    *("baseline", "control", "labels", "mask", "diverse"),
    *("oracle", "resolved", "test_time"),
)
