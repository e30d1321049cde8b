"""Studies: many runs and measurements of one question, as cells that are done once each, and what
they say together."""
