"""Recordings of real robots: readers of the layouts people have, on one time axis and in one camera."""
