"""How good renders, depths and labels are."""
