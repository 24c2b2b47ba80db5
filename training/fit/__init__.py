"""Fit: base distributions of scenarios from recorded traffic."""

from training.fit.filters import EVENT_RECIPES, EventRecipe
from training.fit.mixture import MixtureFit, select_mixture

__all__ = ["EVENT_RECIPES", "EventRecipe", "MixtureFit", "select_mixture"]
