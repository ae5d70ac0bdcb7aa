"""Wide-angle and fisheye lenses from the matches of pairs. Ours; the thesis has no lens."""
