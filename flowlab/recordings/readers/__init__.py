"""The layouts of recordings that flowlab knows."""
