"""F from seven or eight matches (thesis 4.3, 4.4.2)."""
