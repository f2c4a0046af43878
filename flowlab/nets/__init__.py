"""The networks that policies are built from."""
