"""Fitting base distributions of scenarios to recorded traffic."""
