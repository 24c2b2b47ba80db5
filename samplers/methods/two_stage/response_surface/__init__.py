"""Response surface: a regression of f on all that was simulated says where failures are that draws hardly reach."""
