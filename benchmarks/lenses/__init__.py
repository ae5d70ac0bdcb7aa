"""Photos through wide-angle and fisheye lenses."""
