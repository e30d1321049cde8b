"""A run, or any model of Gaussians, to be turned by hand in a browser: `mgs view`."""
