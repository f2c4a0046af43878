"""The stages that come with flowlab."""
