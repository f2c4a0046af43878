"""From pictures to 3D tracks: trackers behind one protocol, chunks, lifting, quality, and how to grade all that."""
