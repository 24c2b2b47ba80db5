"""Recorded scenes as traffic in which drivers learn."""
