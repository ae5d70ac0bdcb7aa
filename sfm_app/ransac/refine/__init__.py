"""The final fit of F, on each of the distances of thesis 4.2."""
