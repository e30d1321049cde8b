"""The mesh prior: rock mesh, samples of its surface, and the initial Gaussians."""
