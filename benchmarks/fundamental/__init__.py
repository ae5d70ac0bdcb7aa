"""Fundamental matrices beside those of OpenCV, PoseLib and pycolmap."""
