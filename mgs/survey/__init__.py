"""The survey: a flight with a noisy depth camera and drifting odometry; its frames are registered
and fused into a cloud."""
