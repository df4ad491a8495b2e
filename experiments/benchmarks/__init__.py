"""One module for each suite of `experiments.bench`; each has `run() -> None` and prints a table."""
