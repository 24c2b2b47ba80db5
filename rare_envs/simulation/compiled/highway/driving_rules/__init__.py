"""Rules of learned drivers beside their networks: close range, lane changes at a hazard rate, keeping the edge.

`settings` says what they are. The other modules need numba, and are compiled for drivers that have such rules alone.
"""
