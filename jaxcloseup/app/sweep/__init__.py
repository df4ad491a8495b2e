"""Ablation sweeps: arms, and their training."""
