"""Several agents: their episode, its step and their rewards."""
