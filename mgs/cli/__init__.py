"""The command line: it reads options, calls the rooms, and prints what came out."""
