"""The survey: a flight with a noisy depth camera and drifting odometry, registered and fused."""
