"""Datasets on disk: read, checked, imported."""
