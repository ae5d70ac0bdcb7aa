"""What runs stages, whatever they do: which are up to date, how they get their products, what disturbed them."""
