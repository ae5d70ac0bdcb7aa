"""The stages of a run, one file each: take products, call the code that does the work, count, return a product."""
