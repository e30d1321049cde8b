"""Active selection: fit, information, criterion, capture, again."""
