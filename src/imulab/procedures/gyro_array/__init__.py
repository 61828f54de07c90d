"""Gyro array: several gyroscopes on one axis, or three, fused into one better rate."""
