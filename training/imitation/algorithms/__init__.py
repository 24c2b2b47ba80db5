"""Imitation algorithms: behaviour cloning, GAIL and MGAIL, and their parts."""

from training.imitation.algorithms.config import Config

__all__ = ["Config"]
