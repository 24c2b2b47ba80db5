"""Imitation algorithms: behaviour cloning, GAIL and MGAIL, and their parts."""
