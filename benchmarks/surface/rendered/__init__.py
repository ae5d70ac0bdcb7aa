"""A surface beside the true one of a rendered scene."""
