"""Everything that the programs do."""
