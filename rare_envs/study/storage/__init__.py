"""Folder of a run as data: its study.json, the table of all its simulations, and how they are read again."""
