"""Published papers: their tables beside ours, from committed results."""
