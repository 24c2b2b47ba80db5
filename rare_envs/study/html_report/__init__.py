"""Report of a run as one HTML file, which needs nothing else: no network, no other file, no script."""
