"""Response surface: a regression of f on all that was simulated says whether the last draws reach its failures."""
