"""The normal map: what a fine surface adds to the triangles of a light one."""
