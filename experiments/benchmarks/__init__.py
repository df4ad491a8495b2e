"""One module for each suite of `experiments.bench`, with `run() -> None`, which prints a table."""
