"""The last adjustment's own arithmetic: poses and points eliminated, covariance of the cameras, what of a lens to free.

COLMAP finds the minimum (`colmap.bundle`); what it does not give is said here.
"""
