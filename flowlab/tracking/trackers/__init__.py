"""The trackers that come with flowlab."""
