"""Cameras, rigid transforms and sampling: pure geometry that knows nothing of robots."""
