"""Files that are written whole or not at all, messages about them, formats, and memory."""
