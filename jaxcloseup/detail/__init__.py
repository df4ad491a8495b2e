"""Detail of the photographs, added to renders."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "add": "Detail Detailed Candidates add_detail find_candidates testify",
        "weights": (
            "Evidence Networks DetailWeights blend expected_errors known_weights one_network "
            "write_known learn_weights sample_evidence"
        ),
        "holes": "find_empty fill_holes",
    },
)
