"""A finished run for other programs: its products in the frame of the export, and the files and folders they go to."""
