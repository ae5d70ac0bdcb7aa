"""Which hypotheses are scored in full (thesis 4.4.4), and whether support could be chance (Moisan and Stival 2004)."""
