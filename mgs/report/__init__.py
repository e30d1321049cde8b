"""What came out: metrics, maps, tables, figures."""
