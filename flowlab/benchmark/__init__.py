"""Experiments, and what their results add up to."""
