"""Learning drivers from recorded traffic."""
