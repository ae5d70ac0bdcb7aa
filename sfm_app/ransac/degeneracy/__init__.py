"""When matches do not determine F (Chum, Werner and Matas 2005; an open problem in thesis 4.5)."""
