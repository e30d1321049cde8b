"""What makes the tables of tools/tables.py, by where their numbers are."""
