"""What an earlier run with other photos knows: pairs whose matches are the same, and cameras."""
