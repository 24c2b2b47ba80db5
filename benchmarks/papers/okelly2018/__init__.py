"""O'Kelly et al. 2018: Tables 1 and 2, Figures 2 and 3 and what they say of the failures, measured on Highway-v0."""
