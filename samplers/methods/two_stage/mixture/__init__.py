"""The mixture proposal of two-stage: its components, their weights and the screening of its draws."""
