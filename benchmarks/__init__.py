"""What the project claims of itself, one command for each subject: `python -m benchmarks.SUBJECT --help`."""
