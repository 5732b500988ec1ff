"""Measuring: trajectories, clouds, speed."""
