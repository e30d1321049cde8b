"""What came out of runs: metrics, maps, tables, figures; and pictures of any model."""
