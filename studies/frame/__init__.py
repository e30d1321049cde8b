"""The frame of every study: cases, cells of work and their sweep, claims, output, the program."""
