"""Moving shutters and zooms: what is measured of them, and what becomes of the poses."""
