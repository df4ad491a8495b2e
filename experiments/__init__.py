"""Scripts driven by absl flags; run from the root of the checkout."""
