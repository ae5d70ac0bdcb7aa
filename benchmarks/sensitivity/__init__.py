"""How much the results depend on each constant that was chosen by hand."""
