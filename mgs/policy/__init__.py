"""What a view is worth: criteria, pose rules, and the registry of policies."""
