"""The programs: their flags, and what they call."""
