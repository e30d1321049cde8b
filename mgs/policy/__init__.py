"""Score candidate views: criteria, pose rules, and the registry of policies."""
