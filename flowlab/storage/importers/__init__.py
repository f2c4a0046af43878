"""Other tools' stores, read as demonstrations."""
