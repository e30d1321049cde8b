"""A flight with a noisy depth camera and drifting odometry, registered into one cloud."""
