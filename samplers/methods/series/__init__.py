"""Series: search by terms, for series systems that offer their terms and the gradients of these."""

from samplers.methods.series.method import Series

__all__ = ["Series"]
