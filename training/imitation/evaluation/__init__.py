"""Evaluation of learned drivers: realism, prediction error, driving statistics, model card."""
