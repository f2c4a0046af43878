"""Labels compared with a truth that is known."""
