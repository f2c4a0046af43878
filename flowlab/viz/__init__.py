"""Pictures of episodes: Rerun recordings and still images. The only package that knows Rerun."""
