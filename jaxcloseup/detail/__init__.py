"""Detail of the photographs, added to renders."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "add": (
            "Detail Detailed Candidates add_detail add_to_rendering find_candidates "
            "label_with_detail leave_out"
        ),
        "weights": (
            "Networks DetailWeights blend expected_errors known_weights mean_output mix "
            "one_network with_larger_errors write_known"
        ),
        "learn": "Evidence learn_weights make_evidence sample_evidence",
        "residuals": "Residuals make_detail render_residuals reproduced",
        "features": "blur_images pixel_features",
        "smoothing": "smooth_depth",
        "holes": "find_empty fill_holes",
    },
)
