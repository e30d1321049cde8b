"""The charts of speed against accuracy, and the presets on scenes that the charts do not use."""
