"""Checks of an ego before a study: its interface, its protocol and its behaviour."""
