"""Centrifuge test: how the acceleration-sensitive drift of a two-axis gyroscope changes with specific force."""
