"""Results of runs: metrics, maps, tables, figures; and pictures of any model."""
