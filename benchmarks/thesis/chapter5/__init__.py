"""Chapter 5: self-calibration."""
