"""Policies: training them, and what training needs."""
