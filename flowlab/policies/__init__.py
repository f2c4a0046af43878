"""The family of policies."""
