"""When matches do not determine F (Chum, Werner and Matas 2005; thesis 4.5 names it as open)."""
