"""The mesh prior: cloud, ground, rock, surface, samples, first Gaussians."""
