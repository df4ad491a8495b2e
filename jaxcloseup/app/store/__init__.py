"""Runs on disk: manifests, and stored runs loaded again."""
