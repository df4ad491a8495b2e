"""Host side, what comes in: captures from disk and procedural scenes."""
