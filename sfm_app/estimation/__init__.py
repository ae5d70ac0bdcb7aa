"""Features, matches, fundamental matrices and cameras of many photos, by any method, and why they give no scene."""
