"""Run `python -m benchmarks.sensitivity`."""

from benchmarks.sensitivity.command import main

if __name__ == "__main__":
    main()
