"""What the photos show of every triangle, and how well."""
