"""Fit Gaussians to images: objective, optimisers, stopping."""
