"""Scans: line scans and point clouds, cut into slices."""
