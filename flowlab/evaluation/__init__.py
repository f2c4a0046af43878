"""What policies are worth: rollouts in simulation."""
