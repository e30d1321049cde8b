"""Studies of mgs, each a program: `python -m studies.NAME OUT` (docs/results.md)."""
