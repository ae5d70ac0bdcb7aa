"""The stages of a run, one file each: take products, call the part that does the work, count, give a product."""
