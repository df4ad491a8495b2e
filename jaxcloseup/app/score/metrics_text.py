"""Metrics for people to read: titles, formatted numbers, and one line for a split."""

from collections.abc import Mapping
from typing import Any


REDUCED = "_reduced"  # end of the name of a split that is scored at the size of training too
SPLIT_TITLES = {
    "test": "Close-ups",
    "test_far": "Ordinary views",
    f"test{REDUCED}": "Close-ups, reduced",
    f"test_far{REDUCED}": "Ordinary views, reduced",
}
COLUMNS = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "resolves": "resolves (px)",
    "could_resolve": "photographs hold (px)",
    "lpips_vgg": "LPIPS (VGG)",
    "lpips_alex": "LPIPS (AlexNet)",
    "cc_psnr": "PSNR, color-corrected (dB)",
    "cc_psnr_gsplat": "PSNR, color-corrected as by gsplat (dB)",
    "cc_psnr_multinerf": "PSNR, color-corrected as by multinerf (dB)",
    "psnr_seen1": "PSNR where seen by 1+ photographs (dB)",
    "psnr_seen3": "PSNR where seen by 3+ photographs (dB)",
    "coverage_seen1": "share seen by 1+ photographs",
    "coverage_seen3": "share seen by 3+ photographs",
    "depth_error_median": "median depth error (relative)",
    "depth_error_p90": "90th percentile depth error (relative)",
    "normal_error_median": "median normal error (degrees)",
    "point_depth_error_median": "median depth error at the capture's points (relative)",
    "point_depth_error_p90": "90th percentile depth error at the capture's points (relative)",
}
# Median errors of depth: against the exact surface, or at the points of a capture.
DEPTH_ERRORS = ("depth_error_median", "point_depth_error_median")


def describe_split(split: Mapping[str, Any]) -> str:
    """Return a split's PSNR, the finest period resolved, and depth error as one line."""
    text = f"PSNR {format_metric('psnr', split['psnr'])} dB"
    if split.get("resolves") is not None:
        text += f", resolves {format_metric('resolves', split['resolves'])} px"
    for key in DEPTH_ERRORS:
        if split.get(key) is not None:
            text += f", depth off by {split[key]:.2%}"
    return text


def format_metric(key: str, value: float | None) -> str:
    """Format a metric's value; "-" stands for a metric that could not be computed."""
    if value is None:
        return "-"
    if "resolve" in key:
        return f"{value:.1f}"
    return f"{value:.2f}" if "psnr" in key or "normal" in key else f"{value:.4f}"
