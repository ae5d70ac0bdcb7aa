"""Select the frames of a video that become photos."""
