"""Pictures of episodes: Rerun recordings, still images and films. The only package that knows Rerun."""
