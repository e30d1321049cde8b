"""Photoreal RGB-D orbits of a rock, rendered with Mitsuba."""
