"""Trajectory and structure as a COLMAP model: cameras, images with poses, points with tracks and real errors."""
