"""Image metrics: PSNR, SSIM, color-corrected PSNR, LPIPS, and the finest period resolved."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "image_metrics": "quantize psnr ssim cc_psnr fit_colors change_colors",
        "color_corrections": "gsplat_cc_psnr multinerf_cc_psnr",
        "resolution": "ring_correlation resolved_period frequencies",
        "perceptual": "LpipsError LpipsWeights layer_shapes load_lpips lpips",
    },
)
