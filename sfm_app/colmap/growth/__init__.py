"""Databases and models of an earlier run, changed to the photos of this one."""
