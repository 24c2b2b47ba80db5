"""The egos that are shipped: how they are trained, and how they are judged."""
