"""Pictures of a simulated scene."""
