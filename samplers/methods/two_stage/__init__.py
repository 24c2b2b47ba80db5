"""Two-stage: explore for failure regions, refine a mixture proposal, estimate with fresh draws."""
