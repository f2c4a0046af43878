"""Where work units run: engines, and the one on this machine."""
