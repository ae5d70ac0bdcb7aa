"""What holds for frames of a video only."""
