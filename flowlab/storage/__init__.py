"""Datasets on disk. The only package that knows zarr."""
