"""Cross-entropy: the search for a proposal block by block, and the estimate from it."""
