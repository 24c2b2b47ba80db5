"""Scenario fitting: base distributions of scenarios from recorded traffic."""

from training.scenario_fitting.event_filters import EVENT_RECIPES, EventRecipe
from training.scenario_fitting.mixture import MixtureFit, select_mixture

__all__ = ["EVENT_RECIPES", "EventRecipe", "MixtureFit", "select_mixture"]
