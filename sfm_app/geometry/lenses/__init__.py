"""Any lens: rays, epipolar geometry of rays, projections, and perspective views into a photo."""
