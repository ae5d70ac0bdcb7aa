"""What every part of a run shares: its context, output folder and manifest, workers, and its cost estimate."""
