"""A camera as a row of numbers: the places of its parameters, and its family.

Apart from `projection`, so that processes of COLMAP need no compiler.
"""

FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 = range(12)
"""Indices of the parameters of a perspective camera, as in COLMAP's FULL_OPENCV; the first ten also of a fisheye."""
SX, SY = K5, K6
"""Indices of sx1 and sy1 of a fisheye, as in COLMAP's THIN_PRISM_FISHEYE."""
CAMERA = 12
"""Number of parameters of a camera. By definition."""
PERSPECTIVE, FISHEYE, PANORAMA = range(3)
"""Families of cameras. A panorama has fx and fy in pixels per radian, cx and cy in pixels, and none of them is free."""
