"""Policies in use."""
