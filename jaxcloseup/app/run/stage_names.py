"""Names that flags accept; importing them must cost nothing, see `define_flags`."""

STAGES = ("baseline", "control", "closeup", "detail", "test_time")
PRESETS = {  # by method; the first one is the default
    "nerf": ("quick", "paper", "released"),
    "dsnerf": ("quick", "paper"),
    "mipnerf": ("quick", "paper"),
    "ngp": ("quick", "paper"),
    "tensorf": ("quick", "paper"),
    "zipnerf": ("quick", "paper"),
    "surfels": ("quick", "standard", "paper", "reduced", "quick_adaptive", "paper_adaptive"),
    "gaussians": ("quick", "paper", "quick_adaptive", "paper_mcmc"),
    "mip_gaussians": ("quick", "paper", "quick_adaptive", "paper_mcmc"),
}
METHODS = {
    "nerf": "a coarse and a fine network (Mildenhall et al. 2020)",
    "dsnerf": "a NeRF whose depth the capture's points supervise (Deng et al. 2022)",
    "mipnerf": "mip-NeRF, a network that sees cones (Barron et al. 2021)",
    "ngp": "Instant-NGP, a hash grid and small networks, with proposals (Müller et al. 2022)",
    "tensorf": "TensoRF, sums of vector-matrix products on a grid that grows (Chen et al. 2022)",
    "zipnerf": "Zip-NeRF, anti-aliased hash features over proposals (Barron et al. 2023)",
    "surfels": "2D Gaussian splatting (Huang et al. 2024)",
    "gaussians": "3D Gaussian splatting (Kerbl et al. 2023)",
    "mip_gaussians": "Mip-Splatting, 3D Gaussians that are filtered (Yu et al. 2024)",
}
ARMS = (
    *("baseline", "control", "labels", "mask", "diverse"),
    *("oracle", "resolved", "test_time"),
)
