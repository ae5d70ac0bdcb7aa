"""The calibrators of thesis chapter 5 as printed, but for misprints."""
