"""From a depth picture to what a policy sees, the same for simulation, real cameras and evaluation."""
