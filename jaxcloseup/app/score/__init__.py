"""Metrics of renders, depths and pseudo-labels; the program is `experiments.evaluate`."""
