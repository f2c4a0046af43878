"""Recipes of typed stages, run unit by unit."""
