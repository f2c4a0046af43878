"""Pictures of episodes: Rerun recordings, still images, videos and figures. The only package that knows Rerun."""
