"""Metrics of renders, depths and pseudo-labels."""
