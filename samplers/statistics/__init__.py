"""Statistics: intervals, importance weights, thresholds, sums over clusters."""
