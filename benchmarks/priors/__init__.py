"""What priors on cameras gain, and what wrong ones cost."""
