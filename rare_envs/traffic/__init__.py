"""Traffic: the state of vehicles on a road, vehicle models, geometry and contact."""
