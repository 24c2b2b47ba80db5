"""Traffic that one driver drives for minutes, and flow and density beside those of recordings."""
