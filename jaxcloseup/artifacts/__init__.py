"""Host side, what goes out: pictures and files."""
