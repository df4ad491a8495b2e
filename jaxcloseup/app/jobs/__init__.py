"""What each program does once its flags are parsed: one module each, with `main() -> None`."""
