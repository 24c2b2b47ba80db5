"""Discovery: lines of descent to the failures, and what may not have been found."""
