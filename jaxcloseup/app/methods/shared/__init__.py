"""What methods share that needs JAX: they import it when training begins, not for `--help`."""
