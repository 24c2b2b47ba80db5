"""The mixture proposal of two-stage: its components and their weights."""
