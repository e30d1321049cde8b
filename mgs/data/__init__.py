"""Datasets on disk: reading, checking and importing them; meshes; and which points a camera
sees."""
