"""Datasets on disk: reading, checking and importing them; meshes; and visibility of points."""
