"""The mesh prior: from a cloud to ground and rock, a mesh of the rock, samples of its surface, and
the Gaussians to start from."""
