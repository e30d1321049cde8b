"""A model in as few bytes as a link allows: the format `.mgs` (docs/bytes.md)."""
