"""Arithmetic of the last bundle adjustment: reduced normal equations, camera covariances, evidence for lens parameters.

COLMAP finds the minimum (`colmap.bundle`); this package computes what COLMAP does not provide.
"""
