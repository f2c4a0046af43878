"""Procedural scenes with exact tracks, to grade trackers on what they were not made for."""
