"""Search by terms: gradient walks, Gaussians in the gradients' subspaces, exact weights; see `search`."""
