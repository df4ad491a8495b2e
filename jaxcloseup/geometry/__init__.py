"""Cameras, rotations, virtual poses, warps and masks: usable alone in any JAX project."""
